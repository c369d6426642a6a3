"""PSNR against scikit-image, torchmetrics and closed forms. Tolerance: 1e-6 dB."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from skimage.metrics import peak_signal_noise_ratio
from torchmetrics.functional.image import peak_signal_noise_ratio as torchmetrics_psnr

from cat3d_core.metrics.psnr import average_error, mean_squared_error, psnr


def test_agrees_with_the_packages_on_photographs(real_pairs, reference):
    prediction, target = real_pairs
    ours = psnr(prediction, target)
    for i in range(len(ours)):
        theirs = peak_signal_noise_ratio(reference.numpy(target[i]), reference.numpy(prediction[i]), data_range=1)
        assert abs(float(ours[i]) - theirs) < 1e-6
        # torchmetrics takes its logarithm's base in float32, whatever the images: hence a relative 1e-7.
        also = torchmetrics_psnr(prediction[i].double(), target[i].double(), data_range=1.0)
        assert float(ours[i]) == pytest.approx(float(also), rel=1e-7)


@given(st.floats(1e-30, 1.0))
def test_constant_difference_has_its_closed_form(difference):
    zeros = torch.zeros(1, 3, 5, 7, dtype=torch.float64)
    assert float(psnr(zeros + difference, zeros)) == pytest.approx(-20 * math.log10(difference), abs=1e-9)


@given(st.floats(1e-15, 1.0))
def test_constant_difference_in_float32(difference):
    zeros = torch.zeros(1, 3, 4, 4)
    assert float(psnr(zeros + difference, zeros)) == pytest.approx(-20 * math.log10(difference), abs=1e-6)


def test_identical_images_are_infinite_with_zero_gradient():
    image = torch.rand(2, 3, 4, 4, requires_grad=True)
    value = psnr(image, image.detach().clone())
    assert torch.isposinf(value).all()
    value.sum().backward()
    assert (image.grad == 0).all()


def test_gradient_matches_finite_differences():
    image, target = (torch.rand(1, 3, 4, 4, dtype=torch.float64) for _ in range(2))
    assert torch.autograd.gradcheck(lambda x: psnr(x, target), image.requires_grad_())


def test_white_against_black_is_zero_decibels():
    assert float(psnr(torch.ones(1, 3, 1, 4096), torch.zeros(1, 3, 1, 4096))) == 0.0


def test_mask_counts_only_its_pixels():
    torch.manual_seed(0)
    prediction, target = torch.rand(2, 3, 6, 5), torch.rand(2, 3, 6, 5)
    mask = torch.rand(2, 6, 5) < 0.5
    expected = [((prediction[i] - target[i])[:, mask[i]].double() ** 2).mean() for i in range(2)]
    torch.testing.assert_close(mean_squared_error(prediction, target, mask), torch.stack(expected), rtol=1e-6, atol=0)
    assert psnr(prediction, target, torch.zeros(2, 6, 5)).isnan().all()


def test_half_precision_is_widened_before_the_difference():
    target = torch.rand(1, 3, 8, 8).half()
    prediction = target + torch.tensor(0.01).half()
    torch.testing.assert_close(psnr(prediction, target), psnr(prediction.float(), target.float()), rtol=0, atol=0)


def test_average_error_is_the_geometric_mean():
    value = average_error(torch.tensor(20.0), torch.tensor(0.75), torch.tensor(0.2))
    assert float(value) == pytest.approx((0.01 * 0.5 * 0.2) ** (1 / 3), rel=1e-6)


@pytest.mark.parametrize(
    ("prediction", "target", "message"),
    [
        (torch.rand(3, 4, 4), torch.rand(3, 4, 4), "expected a batch"),
        (torch.rand(1, 3, 4, 4), torch.rand(1, 3, 4, 5), "differ in shape"),
        (torch.zeros(1, 3, 4, 4, dtype=torch.uint8), torch.zeros(1, 3, 4, 4), "divide uint8 images by 255"),
        (torch.rand(1, 3, 0, 4), torch.rand(1, 3, 0, 4), "hold no pixels"),
    ],
)
def test_wrong_arguments_are_named(prediction, target, message):
    with pytest.raises(ValueError, match=message):
        psnr(prediction, target)


def test_mask_of_another_shape_is_named():
    with pytest.raises(ValueError, match=r"expected \(1, 4, 4\)"):
        psnr(torch.rand(1, 3, 4, 4), torch.rand(1, 3, 4, 4), torch.ones(1, 1, 4, 4))
