"""Each protocol against the code it names, re-derived in float64 or run from the package, on real images."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from skimage.metrics import structural_similarity

from cat3d_core.metrics.perceptual import PerceptualDistance
from cat3d_core.metrics.protocols import PROTOCOLS, evaluate, quantize


def psnr64(x, y):
    return -10 * math.log10(((x.astype(np.float64) - y.astype(np.float64)) ** 2).mean())


def check(result, psnr, ssim):
    assert abs(result["psnr"] - psnr) < 1e-6
    assert abs(result["ssim"] - ssim) < 1e-6


@pytest.fixture
def pair(real_pairs):
    """A noisy photograph in float (not on the grid of 8 bits) and its clean one, 200x250."""
    return real_pairs[0][0, :, 50:250, 100:350], real_pairs[1][0, :, 50:250, 100:350]


def test_google(pair, reference):
    x, y = (reference.numpy(i) for i in pair)
    check(evaluate("google", *pair), psnr64(x, y), reference.ssim(x, y, reference.gaussian))


@pytest.mark.parametrize(("name", "data_range"), [("regnerf", 2.0), ("freenerf", 1.0)])
def test_regnerf_and_freenerf(pair, masked_pair, reference, name, data_range):
    x, y = (reference.numpy(i) for i in pair)
    check(evaluate(name, *pair), psnr64(x, y), structural_similarity(x, y, channel_axis=2, data_range=data_range))
    prediction, target, mask = masked_pair
    x, y, m = reference.numpy(prediction), reference.numpy(target), mask.numpy()[..., None].astype(np.float64)
    inside = psnr64(x[mask.numpy()], y[mask.numpy()])
    x, y = x * m + (1 - m), y * m + (1 - m)
    similarity = structural_similarity(x, y, channel_axis=2, data_range=data_range)
    check(evaluate(name, prediction, target, mask), inside, similarity)


def test_soft_masks_as_regnerf_reads_them(pair, reference):
    """PSNR where the mask is exactly 1; the composite with the fractions."""
    mask = torch.linspace(0, 2, pair[0].shape[2]).clamp(max=1).expand(pair[0].shape[1:]).contiguous()
    x, y = (reference.numpy(i) for i in pair)
    m = mask.numpy()[..., None].astype(np.float64)
    whole = (m == 1)[..., 0]
    expected = structural_similarity(x * m + (1 - m), y * m + (1 - m), channel_axis=2, data_range=1.0)
    check(evaluate("freenerf", *pair, mask), psnr64(x[whole], y[whole]), expected)


def test_3dgs(pair, reference):
    """From PNG files (torchvision's save_image adds a half and truncates), zero-padded window."""
    x, y = (
        np.floor(reference.numpy(i).astype(np.float32) * np.float32(255) + np.float32(0.5)).astype(np.uint8) / 255
        for i in pair
    )
    check(evaluate("3dgs", *pair), psnr64(x, y), reference.ssim(x, y, reference.gaussian, pad=5))


def test_nerfbaselines(pair, masked_pair, reference):
    """convert_image_dtype truncates; masks blacken both images before every metric."""

    def to_8_bits(image):
        return (reference.numpy(image).astype(np.float32) * 255).clip(0, 255).astype(np.uint8) / 255

    x, y = (to_8_bits(i) for i in pair)
    check(evaluate("nerfbaselines", *pair), psnr64(x, y), reference.ssim(x, y, reference.gaussian))
    prediction, target, mask = masked_pair
    x, y = (to_8_bits(i) * mask.numpy()[..., None] for i in (prediction, target))
    result = evaluate("nerfbaselines", prediction, target, mask)
    check(result, psnr64(x, y), reference.ssim(x, y, reference.gaussian))


def test_google_against_dm_pix_itself(real_pairs):
    """In float64, all three photographs. dm_pix needs JAX, which the tests don't install."""
    dm_pix = pytest.importorskip("dm_pix")
    jax = pytest.importorskip("jax")
    jax.config.update("jax_enable_x64", True)
    for prediction, target in zip(*real_pairs):
        x, y = (i.permute(1, 2, 0).double().numpy() for i in (prediction, target))
        expected = float(dm_pix.ssim(jax.numpy.asarray(x), jax.numpy.asarray(y)))
        check(evaluate("google", prediction, target), psnr64(x, y), expected)


def test_nerfbaselines_against_the_package_itself(pair, masked_pair):
    """Its 8-bit conversion and its metrics, fed float64 (it computes in float32, to about 1e-6)."""
    metrics = pytest.importorskip("nerfbaselines.metrics")
    utils = pytest.importorskip("nerfbaselines.utils")

    def converted(image):
        eight = utils.image_to_srgb(image.permute(1, 2, 0).numpy(), np.uint8, color_space="srgb")
        return utils.convert_image_dtype(eight, np.float32).astype(np.float64)[None]

    for prediction, target, *mask in (pair, masked_pair):
        x, y = converted(prediction), converted(target)
        if mask:
            x, y = (i * mask[0].numpy()[None, ..., None] for i in (x, y))
        result = evaluate("nerfbaselines", prediction, target, *mask)
        check(result, float(-10 * np.log10(((x - y) ** 2).mean())), float(metrics.dmpix_ssim(x, y)[0]))
        assert result["ssim"] == pytest.approx(float(metrics.ssim(x, y)[0]), abs=5e-6)
        assert result["psnr"] == pytest.approx(float(metrics.psnr(x, y)[0]), abs=5e-5)


def test_3dgs_against_its_own_convolution(pair):
    """loss_utils.ssim of the splatting code: grouped convolution with zeros around the image, here in float64."""
    line = torch.tensor([math.exp(-((i - 5) ** 2) / (2 * 1.5**2)) for i in range(11)], dtype=torch.float64)
    window = (line[:, None] * line / line.sum() ** 2).expand(3, 1, 11, 11)

    def mean(images):
        return torch.nn.functional.conv2d(images, window, padding=5, groups=3)

    x, y = (quantize(i[None], "round").double() for i in pair)
    mu_x, mu_y = mean(x), mean(y)
    var_x, var_y, covariance = mean(x * x) - mu_x**2, mean(y * y) - mu_y**2, mean(x * y) - mu_x * mu_y
    c1, c2 = 0.01**2, 0.03**2
    local = (2 * mu_x * mu_y + c1) * (2 * covariance + c2) / ((mu_x**2 + mu_y**2 + c1) * (var_x + var_y + c2))
    check(evaluate("3dgs", *pair), float(-10 * torch.log10(((x - y) ** 2).mean())), float(local.mean()))


def test_perceptual_column_is_named_after_what_was_measured_and_fed_its_range(pair):
    distance = PerceptualDistance("lpips-squeeze")
    prediction, target = (i[None] for i in pair)
    with torch.no_grad():
        scaled, raw = float(distance(prediction, target)), float(distance(prediction, target, normalize=False))
    assert scaled != pytest.approx(raw, rel=1e-3)
    for name, expected in (("google", scaled), ("freenerf", raw)):
        result = evaluate(name, *pair, perceptual=distance)
        assert sorted(result) == ["lpips-squeeze", "psnr", "ssim"]
        assert result["lpips-squeeze"] == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("name", PROTOCOLS)
def test_identical_images(name):
    image = torch.rand(3, 32, 32)
    assert evaluate(name, image, image.clone()) == {"psnr": math.inf, "ssim": 1.0}


@pytest.mark.parametrize("name", PROTOCOLS)
def test_white_against_black(name):
    result = evaluate(name, torch.ones(3, 32, 32), torch.zeros(3, 32, 32))
    assert result["psnr"] == 0.0
    assert 0 < result["ssim"] < 0.02 or name == "3dgs"


@pytest.mark.parametrize("name", PROTOCOLS)
def test_predictions_are_clamped(name):
    torch.manual_seed(0)
    prediction, target = torch.randn(3, 20, 24), torch.rand(3, 20, 24)
    assert evaluate(name, prediction, target) == evaluate(name, prediction.clamp(0, 1), target)


@pytest.mark.parametrize("how", ["round", "truncate"])
def test_eight_bit_images_survive_quantisation(how):
    image = torch.arange(256, dtype=torch.float32) / 255
    assert torch.equal(quantize(image, how), image)


@given(st.floats(0, 1, width=32))
def test_quantisation_is_within_its_step(value):
    x = torch.tensor([value])
    assert abs(float(quantize(x, "round") - x)) <= 0.5 / 255 + 1e-7
    assert -1e-7 <= float(x - quantize(x, "truncate")) <= 1 / 255 + 1e-7


def image(value=0.5, size=(16, 16)):
    return torch.full((3, *size), value)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("psnr", image(), image()), "no metric protocol 'psnr'; choose one of google"),
        (("google", image(), image(), torch.ones(16, 16)), "'google' defines no masked metrics; use one of regnerf"),
        (("regnerf", image(), image(), torch.zeros(16, 16)), "mask selects no pixel"),
        (("google", image(math.nan), image()), "prediction holds NaN"),
        (("google", image(), image(math.inf)), "target holds NaN or infinite"),
        (("google", image(), image(2.0)), r"target has values in \[2, 2\]"),
        (("google", image(size=(1, 1)), image(size=(1, 1))), "at least 11x11 pixels; these images are 1x1"),
        (("regnerf", image(size=(1, 4096)), image(size=(1, 4096))), "at least 7x7 pixels; these images are 4096x1"),
        (("google", image()[None], image()[None]), "takes one view"),
        (("google", image().to(torch.uint8), image()), "divide uint8 images by 255"),
    ],
)
def test_errors_are_sentences(arguments, message):
    with pytest.raises(ValueError, match=message):
        evaluate(*arguments)
