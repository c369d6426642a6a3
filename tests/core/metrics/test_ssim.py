"""SSIM against a float64 definition, scikit-image, pytorch-msssim and torchmetrics.

Tolerance 1e-12 for float32 images and float64 references; 1e-6 and 1e-5 where a package's own kernel is float32.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from pytorch_msssim import ssim as msssim_ssim
from skimage.metrics import structural_similarity
from torchmetrics.functional.image import structural_similarity_index_measure

from cat3d_core.metrics.ssim import WINDOWS, ssim, ssim_map

SEEDS = st.integers(0, 2**31)


def expected(reference, window, x, y, data_range=1.0):
    arguments = {
        "gaussian_valid": (reference.gaussian, 0, False),
        "gaussian_same": (reference.gaussian, 5, False),
        "uniform_valid": (reference.box, 0, True),
    }[window]
    return reference.ssim(reference.numpy(x), reference.numpy(y), *arguments, data_range)


@pytest.mark.parametrize("window", WINDOWS)
@pytest.mark.parametrize("data_range", [1.0, 2.0])
def test_agrees_with_the_definition_on_photographs(real_pairs, reference, window, data_range):
    prediction, target = (x[:, :, 50:170, 100:260] for x in real_pairs)
    ours = ssim(prediction, target, window, data_range)
    for i in range(len(ours)):
        value = expected(reference, window, prediction[i], target[i], data_range)
        assert abs(float(ours[i]) - value) < 1e-12


def test_agrees_with_scikit_image(real_pairs, reference):
    prediction, target = real_pairs
    for i in range(len(target)):
        x, y = reference.numpy(prediction[i]), reference.numpy(target[i])
        box = structural_similarity(x, y, channel_axis=2, data_range=1.0)
        assert abs(float(ssim(prediction, target, "uniform_valid")[i]) - box) < 1e-6
        gaussian = structural_similarity(
            x, y, channel_axis=2, data_range=1.0, gaussian_weights=True, sigma=1.5, use_sample_covariance=False
        )
        assert abs(float(ssim(prediction, target)[i]) - gaussian) < 1e-6


def test_agrees_with_torch_packages(real_pairs):
    prediction, target = (x[:, :, 50:150, 100:250].double() for x in real_pairs)
    ours = ssim(prediction.float(), target.float())
    _, full = structural_similarity_index_measure(
        prediction, target, data_range=1.0, reduction="none", return_full_image=True
    )
    # torchmetrics 1.9 averages over a border of reflected pixels too: its mean differs in the third digit, its map not.
    torch.testing.assert_close(ours, full[..., 5:-5, 5:-5].mean(dim=(1, 2, 3)), rtol=0, atol=1e-6)
    # pytorch-msssim's Gaussian is float32, whatever the images, and its covariances are those of that window.
    theirs = msssim_ssim(prediction, target, data_range=1.0, size_average=False)
    torch.testing.assert_close(ours, theirs, rtol=0, atol=1e-5)
    taps = torch.tensor(WINDOWS["gaussian_valid"].taps, dtype=torch.float64).view(1, 1, 1, -1).repeat(3, 1, 1, 1)
    theirs = msssim_ssim(prediction, target, data_range=1.0, size_average=False, win=taps)
    torch.testing.assert_close(ours, theirs, rtol=0, atol=1e-12)


@pytest.mark.parametrize("window", WINDOWS)
@pytest.mark.parametrize("kind", ["white", "black", "grey", "photo-like"])
def test_identical_images_are_exactly_one(window, kind):
    image = {"white": torch.ones, "black": torch.zeros}.get(kind, torch.rand)(2, 3, 20, 17)
    image = torch.full_like(image, 0.123) if kind == "grey" else image
    assert (ssim(image, image.clone(), window) == 1.0).all()
    assert (ssim_map(image, image.clone(), window) == 1.0).all()


@pytest.mark.parametrize("window", ["gaussian_valid", "uniform_valid"])
@given(a=st.floats(0, 1), b=st.floats(0, 1))
def test_constant_images_have_their_closed_form(window, a, b):
    x, y = (torch.full((1, 3, 16, 16), v, dtype=torch.float64) for v in (a, b))
    value = (2 * a * b + 1e-4) / (a * a + b * b + 1e-4)
    assert float(ssim(x, y, window)) == pytest.approx(value, abs=1e-12)


@given(seed=SEEDS, window=st.sampled_from(sorted(WINDOWS)), exponent=st.integers(-12, 0), base=st.floats(0, 1))
def test_never_above_one_and_symmetric(seed, window, exponent, base):
    """Nearly equal images on any background: the case in which E[x^2] - E[x]^2 gives SSIM above 1."""
    g = torch.Generator().manual_seed(seed)
    x = (base + 10.0**exponent * torch.randn(1, 3, 24, 21, generator=g)).clamp(0, 1)
    y = (x + 10.0**exponent * torch.randn(1, 3, 24, 21, generator=g)).clamp(0, 1)
    local = ssim_map(x, y, window)
    assert float(local.max()) <= 1.0
    assert float(local.min()) >= -1.0
    torch.testing.assert_close(local, ssim_map(y, x, window), rtol=0, atol=1e-12)


@pytest.mark.parametrize("window", WINDOWS)
def test_gradient_matches_finite_differences(window):
    torch.manual_seed(1)
    x, y = (torch.rand(1, 1, 12, 12, dtype=torch.float64) for _ in range(2))
    assert torch.autograd.gradcheck(lambda i: ssim(i, y, window), x.requires_grad_(), atol=1e-6)


@pytest.mark.parametrize("window", WINDOWS)
@pytest.mark.parametrize("value", [0.0, 0.5, 1.0])
def test_gradient_is_finite_on_flat_and_identical_images(window, value):
    x = torch.full((1, 3, 16, 16), value, requires_grad=True)
    for target in (x.detach().clone(), torch.rand(1, 3, 16, 16)):
        (gradient,) = torch.autograd.grad(ssim(x, target, window).sum(), x)
        assert gradient.isfinite().all()


@pytest.mark.parametrize("window", ["gaussian_valid", "uniform_valid"])
@pytest.mark.parametrize("shape", [(1, 1), (1, 4096), (6, 6), (10, 4096)])
def test_images_smaller_than_the_window_are_refused_or_fit(window, shape):
    image = torch.rand(1, 3, *shape)
    size = len(WINDOWS[window].taps)
    if min(shape) < size:
        with pytest.raises(ValueError, match=rf"at least {size}x{size} pixels; these images are {shape[1]}x{shape[0]}"):
            ssim(image, image, window)
    else:
        assert float(ssim(image, image, window)) == 1.0


@pytest.mark.parametrize("shape", [(1, 1), (1, 4096), (3, 2)])
def test_zero_padding_takes_any_size(shape, reference):
    x, y = torch.rand(1, 3, *shape), torch.rand(1, 3, *shape)
    assert abs(float(ssim(x, y, "gaussian_same")) - expected(reference, "gaussian_same", x[0], y[0])) < 1e-6


def test_smallest_image_has_one_window(reference):
    x, y = torch.rand(1, 3, 11, 11), torch.rand(1, 3, 11, 11)
    assert ssim_map(x, y).shape == (1, 3, 1, 1)
    assert abs(float(ssim(x, y)) - expected(reference, "gaussian_valid", x[0], y[0])) < 1e-6


@pytest.mark.parametrize("window", WINDOWS)
def test_batch_equals_one_by_one(window):
    x, y = torch.rand(5, 3, 20, 30), torch.rand(5, 3, 20, 30)
    each = torch.cat([ssim(x[i : i + 1], y[i : i + 1], window) for i in range(5)])
    torch.testing.assert_close(ssim(x, y, window), each, rtol=0, atol=1e-6)


@pytest.mark.parametrize("window", WINDOWS)
def test_mask_weighs_windows_by_their_centre(window):
    x, y = torch.rand(2, 3, 20, 30), torch.rand(2, 3, 20, 30)
    local, border = ssim_map(x, y, window).double().mean(1).numpy(), WINDOWS[window].border
    mask = torch.rand(2, 20, 30) < 0.3
    inside = mask.numpy()[:, border : 20 - border, border : 30 - border]
    expected_values = np.array([local[i][inside[i]].mean() for i in range(2)])
    np.testing.assert_allclose(ssim(x, y, window, mask=mask).numpy(), expected_values, rtol=0, atol=1e-12)
    torch.testing.assert_close(ssim(x, y, window, mask=torch.ones(2, 20, 30)), ssim(x, y, window))


def test_unknown_window_is_named():
    with pytest.raises(ValueError, match="no SSIM window 'hann'"):
        ssim(torch.rand(1, 3, 16, 16), torch.rand(1, 3, 16, 16), "hann")
