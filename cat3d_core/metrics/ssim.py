"""Structural similarity (Wang et al. 2004) in the variants that published tables use.

Written in the sum s = x + y and the difference d = x - y of the two images:

    2 mu_x mu_y   = (E[s]^2 - E[d]^2) / 2        2 cov(x, y)    = (var s - var d) / 2
    mu_x^2+mu_y^2 = (E[s]^2 + E[d]^2) / 2        var x + var y  = (var s + var d) / 2

This takes four local means instead of five. With both variances clamped at zero |SSIM| <= 1 holds by construction, and
identical images (d = 0) give exactly 1, where E[x^2] - E[x]^2 of each image on its own rounds to values above 1.
"""

from __future__ import annotations

import ctypes
import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from cat3d_core.cpu_library import pointer
from cat3d_core.metrics.images import image_pair, kernels_for


@dataclass(frozen=True)
class Window:
    """A separable local window: `taps` (odd count, sum 1); what happens at the border; the variance's normaliser."""

    taps: tuple[float, ...]
    zero_padded: bool = False
    bessel: bool = False

    @property
    def border(self) -> int:
        """Pixels by which the SSIM map is smaller than the image on each side."""
        return 0 if self.zero_padded else len(self.taps) // 2

    @property
    def variance_scale(self) -> float:
        """n / (n - 1) for the sample covariance of scikit-image, n pixels in the window; else 1."""
        count = len(self.taps) ** 2
        return count / (count - 1) if self.bessel else 1.0


_TILE = 3 << 16  # values of each image worked on at a time, so that they stay in a processor's cache
_TILE_ROWS = 16  # at least: neighbouring tiles share a window's worth of rows


def _gaussian_taps(count: int = 11, sigma: float = 1.5) -> tuple[float, ...]:
    weights = [math.exp(-0.5 * ((i - count // 2) / sigma) ** 2) for i in range(count)]
    return tuple(w / sum(weights) for w in weights)


WINDOWS: dict[str, Window] = {
    # dm_pix, TensorFlow, pytorch-msssim: only windows inside the image (torchmetrics 1.9 adds a reflected border).
    "gaussian_valid": Window(_gaussian_taps()),
    # The 3D Gaussian splatting family: conv2d with padding 5, so the image is followed by black.
    "gaussian_same": Window(_gaussian_taps(), zero_padded=True),
    # scikit-image's default: 7x7 box, sample covariance, border cropped.
    "uniform_valid": Window((1 / 7,) * 7, bessel=True),
}


def _local_mean(images: Tensor, taps: tuple[float, ...]) -> Tensor:
    """(..., h, w) -> (..., h - k + 1, w - k + 1), by a window of k taps along each axis.

    Shifted slices added into one sum: on a CPU several times faster than a convolution, and than anything that needs
    more temporaries.
    """
    for axis in (-2, -1):
        length = images.shape[axis] - len(taps) + 1
        total = images.narrow(axis, 0, length) * taps[0]
        for i, tap in enumerate(taps[1:], 1):
            total.add_(images.narrow(axis, i, length), alpha=tap)
        images = total
    return images


def _check_size(images: Tensor, window: str) -> None:
    if window not in WINDOWS:
        raise ValueError(f"There is no SSIM window '{window}'; choose one of {', '.join(WINDOWS)}.")
    size, (height, width) = len(WINDOWS[window].taps), images.shape[2:]
    if not WINDOWS[window].zero_padded and min(height, width) < size:
        raise ValueError(
            f"SSIM '{window}' needs at least {size}x{size} pixels; these images are {width}x{height} (width x height)."
        )


def _padded(images: Tensor, window: Window) -> Tensor:
    return F.pad(images, (len(window.taps) // 2,) * 4) if window.zero_padded else images


def _moments(field: Tensor, taps: tuple[float, ...]) -> tuple[Tensor, Tensor]:
    """Square of the local mean, and local variance."""
    # Variance does not depend on the origin; measured from the image's mean the cancellation is least.
    origin = field.detach().mean(dim=(-2, -1), keepdim=True)
    field.sub_(origin)
    mean = _local_mean(field, taps)
    variance = torch.addcmul(_local_mean(field.square(), taps), mean, mean, value=-1.0)
    return (mean + origin).square_(), variance.clamp_min_(0.0)


def _similarity(of_sum: Tensor, of_difference: Tensor, constant: float) -> Tensor:
    """(S - D + 2 c) / (S + D + 2 c), written 1 - 2 D / (S + D + 2 c): exactly 1 where D is 0."""
    one = torch.ones((), dtype=of_sum.dtype, device=of_sum.device)
    return torch.addcdiv(one, of_difference, (of_sum + of_difference).add_(2 * constant), value=-2.0)


def _local_ssim(prediction: Tensor, target: Tensor, window: Window, data_range: float) -> Tensor:
    """(B, C, h, w) pair -> (B, C, h - k + 1, w - k + 1) float64: the windows inside."""
    prediction, target = prediction.double(), target.double()
    mean_sum, var_sum = _moments(prediction + target, window.taps)
    mean_difference, var_difference = _moments(prediction - target, window.taps)
    luminance = _similarity(mean_sum, mean_difference, (0.01 * data_range) ** 2)
    return luminance.mul_(_similarity(var_sum, var_difference, (0.03 * data_range) ** 2 / window.variance_scale))


def ssim_map(prediction: Tensor, target: Tensor, window: str = "gaussian_valid", data_range: float = 1.0) -> Tensor:
    """Local SSIM (B, C, H - 2 border, W - 2 border) float64, in [-1, 1].

    prediction, target (B, C, H, W) in [0, data_range]; `window` a name in WINDOWS. The constants are
    (0.01 data_range)^2 and (0.03 data_range)^2. Float64 inside and out, whatever the images: in float32 the rounding of
    the window's sum alone moves a photograph's SSIM by more than 1e-6. Raises ValueError where the image is smaller
    than the window, or for an unknown window.
    """
    prediction, target, _ = image_pair(prediction, target)
    _check_size(prediction, window)
    shape = WINDOWS[window]
    return _local_ssim(_padded(prediction, shape), _padded(target, shape), shape, data_range)


def ssim(
    prediction: Tensor,
    target: Tensor,
    window: str = "gaussian_valid",
    data_range: float = 1.0,
    mask: Tensor | None = None,
) -> Tensor:
    """Mean local SSIM of each image, over positions and channels: (B,) float64.

    prediction, target (B, C, H, W) in [0, data_range]; mask (B, H, W) weighs the windows by the pixel at their centre
    (no weight left gives NaN). Works in tiles of rows: beside the images, memory does not grow with them. Raises as
    `ssim_map`.
    """
    prediction, target, mask = image_pair(prediction, target, mask)
    _check_size(prediction, window)
    shape = WINDOWS[window]
    kernels = kernels_for(prediction, target)
    if kernels is not None:
        return _by_kernel(kernels, prediction, target, mask, shape, data_range)
    images = max(1, _TILE // prediction[0].numel())
    masks = [None] * len(prediction) if mask is None else mask.split(images)
    parts = zip(prediction.split(images), target.split(images), masks)
    return torch.cat([_tiled(x, y, m, shape, data_range) for x, y, m in parts])


def _by_kernel(
    kernels: ctypes.CDLL, prediction: Tensor, target: Tensor, mask: Tensor | None, window: Window, data_range: float
) -> Tensor:
    """`ssim` by the kernel, in one pass over the images."""
    images, channels, height, width = prediction.shape
    prediction, target = prediction.contiguous(), target.contiguous()
    weights = None if mask is None else mask.double().contiguous()
    out = prediction.new_empty((images, channels), dtype=torch.float64)
    constants = (0.01 * data_range) ** 2, (0.03 * data_range) ** 2 / window.variance_scale
    kernels.structural_similarity(
        *(pointer(x) for x in (prediction, target, weights, out)), ctypes.c_int64(images), ctypes.c_int(channels),
        ctypes.c_int(height), ctypes.c_int(width), (ctypes.c_double * len(window.taps))(*window.taps),
        ctypes.c_int(len(window.taps)), ctypes.c_int(len(window.taps) // 2 if window.zero_padded else 0),
        *map(ctypes.c_double, constants), ctypes.c_int(torch.get_num_threads()),
    )  # fmt: skip
    border = window.border
    if weights is None:
        return out.mean(1) / ((height - 2 * border) * (width - 2 * border))
    return out.mean(1) / weights[:, border : height - border, border : width - border].sum(dim=(1, 2))


def _tiled(prediction: Tensor, target: Tensor, mask: Tensor | None, window: Window, data_range: float) -> Tensor:
    """`ssim` of a few images: (B,)."""
    prediction, target = _padded(prediction, window), _padded(target, window)
    halo, border = len(window.taps) - 1, window.border
    height, width = prediction.shape[2] - halo, prediction.shape[3] - halo
    rows = max(_TILE_ROWS, _TILE // prediction[:, :, 0].numel())
    total = weight = prediction.new_zeros(len(prediction), dtype=torch.float64)
    for top in range(0, height, rows):
        bottom = min(top + rows, height)
        part = slice(top, bottom + halo)
        local = _local_ssim(prediction[:, :, part], target[:, :, part], window, data_range).mean(dim=1)
        if mask is not None:
            weights = mask[:, border + top : border + bottom, border : border + width].double()
            local = local * weights
            weight = weight + weights.sum(dim=(1, 2))
        total = total + local.sum(dim=(1, 2))
    return total / (height * width if mask is None else weight)
