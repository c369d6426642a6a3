"""Peak signal-to-noise ratio."""

from __future__ import annotations

import ctypes

import torch
from torch import Tensor

from cat3d_core.cpu_library import pointer
from cat3d_core.metrics.images import image_pair, kernels_for


def mean_squared_error(prediction: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """Mean over pixels and channels of the squared difference: (B,) float64.

    prediction, target (B, C, H, W); mask (B, H, W) weighs the pixels (an empty mask gives NaN: nothing was measured).
    Squares are float32 for float32 images (relative error about 1e-7; differences below 1e-22 count as none), but
    without a mask on the CPU all is float64.
    """
    prediction, target, mask = image_pair(prediction, target, mask)
    kernels = kernels_for(prediction, target) if mask is None else None
    if kernels is not None:
        out = prediction.new_empty(len(prediction), dtype=torch.float64)
        prediction, target = prediction.contiguous(), target.contiguous()
        kernels.squared_error(
            *(pointer(x) for x in (prediction, target, out)), ctypes.c_int64(len(prediction)),
            ctypes.c_int64(prediction[0].numel()), ctypes.c_int(torch.get_num_threads()),
        )  # fmt: skip
        return out
    squared = (prediction - target).square_()
    if mask is None:
        return squared.mean(dim=(1, 2, 3)).double()
    weight = mask.double()
    return (squared.mean(dim=1).double() * weight).sum(dim=(1, 2)) / weight.sum(dim=(1, 2))


def psnr(prediction: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """-10 log10(mean squared error) in decibels for a peak of 1: (B,) float64.

    prediction, target (B, C, H, W) in [0, 1]; mask (B, H, W) weighs the pixels. Identical images have PSNR +inf, and
    the gradient there is zero (not NaN).
    """
    error = mean_squared_error(prediction, target, mask)
    tiny = torch.finfo(error.dtype).tiny
    decibels = -10.0 * torch.log10(error.clamp_min(tiny))
    return torch.where(error == 0, torch.full_like(decibels, torch.inf), decibels)


def average_error(psnr_db: Tensor, ssim: Tensor, lpips: Tensor) -> Tensor:
    """RegNeRF's one number: the geometric mean of MSE, sqrt(1 - SSIM) and LPIPS (all of one shape)."""
    return (10.0 ** (-0.1 * psnr_db) * (1.0 - ssim).clamp_min(0.0).sqrt() * lpips) ** (1.0 / 3.0)
