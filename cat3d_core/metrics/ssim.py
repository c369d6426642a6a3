"""Structural similarity (Wang et al. 2004) in the variants that published tables use.

Written in the sum s = x + y and the difference d = x - y of the two images:

    2 mu_x mu_y   = (E[s]^2 - E[d]^2) / 2        2 cov(x, y)    = (var s - var d) / 2
    mu_x^2+mu_y^2 = (E[s]^2 + E[d]^2) / 2        var x + var y  = (var s + var d) / 2

This takes four local means instead of five. With both variances clamped at zero |SSIM| <= 1 holds by construction, and
identical images (d = 0) give exactly 1, where E[x^2] - E[x]^2 of each image on its own rounds to values above 1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from cat3d_core.metrics.images import image_pair


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


_CHUNK = 1 << 20  # values of a batch that are worked on at a time


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
    """(..., h, w) -> (..., h - k + 1, w - k + 1), by a symmetric window of k taps along each axis.

    Sums of shifted slices: for a few planes several times faster on a CPU than a convolution.
    """
    half = len(taps) // 2
    for axis in (-2, -1):
        length = images.shape[axis] - 2 * half
        total = images.narrow(axis, half, length) * taps[half]
        for i in range(half):
            pair = images.narrow(axis, i, length) + images.narrow(axis, 2 * half - i, length)
            total.add_(pair, alpha=taps[i])
        images = total
    return images


def ssim_map(prediction: Tensor, target: Tensor, window: str = "gaussian_valid", data_range: float = 1.0) -> Tensor:
    """Local SSIM (B, C, H - 2 border, W - 2 border) float64, in [-1, 1].

    prediction, target (B, C, H, W) in [0, data_range]; `window` a name in WINDOWS. The constants are
    (0.01 data_range)^2 and (0.03 data_range)^2. Float64 inside and out, whatever the images: in float32 the rounding of
    the window's sum alone moves a photograph's SSIM by more than 1e-6. Raises ValueError where the image is smaller
    than the window, or for an unknown window.
    """
    prediction, target, _ = image_pair(prediction, target)
    if window not in WINDOWS:
        raise ValueError(f"There is no SSIM window '{window}'; choose one of {', '.join(WINDOWS)}.")
    shape = WINDOWS[window]
    size = len(shape.taps)
    if not shape.zero_padded and min(prediction.shape[2:]) < size:
        height, width = prediction.shape[2:]
        raise ValueError(
            f"SSIM '{window}' needs at least {size}x{size} pixels; these images are {width}x{height} (width x height)."
        )
    prediction, target = prediction.double(), target.double()
    c1, c2 = (0.01 * data_range) ** 2, (0.03 * data_range) ** 2

    def moments(images: Tensor) -> tuple[Tensor, Tensor]:
        if shape.zero_padded:
            images = F.pad(images, (size // 2,) * 4)
        # Variance does not depend on the origin; measured from the image's mean the cancellation is least.
        origin = images.detach().mean(dim=(2, 3), keepdim=True)
        centred = images - origin
        mean = _local_mean(centred, shape.taps)
        variance = (_local_mean(centred.square(), shape.taps) - mean.square()).clamp_min(0.0)
        return mean + origin, variance * shape.variance_scale

    mean_sum, var_sum = moments(prediction + target)
    mean_difference, var_difference = moments(prediction - target)
    mean_sum, mean_difference = mean_sum.square(), mean_difference.square()
    luminance = (mean_sum - mean_difference + 2 * c1) / (mean_sum + mean_difference + 2 * c1)
    structure = (var_sum - var_difference + 2 * c2) / (var_sum + var_difference + 2 * c2)
    return luminance * structure


def ssim(
    prediction: Tensor,
    target: Tensor,
    window: str = "gaussian_valid",
    data_range: float = 1.0,
    mask: Tensor | None = None,
) -> Tensor:
    """Mean local SSIM of each image, over positions and channels: (B,) float64.

    prediction, target (B, C, H, W) in [0, data_range]; mask (B, H, W) weighs the windows by the pixel at their centre
    (no weight left gives NaN). Raises as `ssim_map`.
    """
    prediction, target, mask = image_pair(prediction, target, mask)
    # Image by image where they are large: the working set then stays in the processor's cache.
    images = max(1, _CHUNK // prediction[0].numel())
    pairs = zip(prediction.split(images), target.split(images), strict=True)
    parts = [ssim_map(x, y, window, data_range).mean(dim=1) for x, y in pairs]
    local = torch.cat(parts)
    if mask is None:
        return local.mean(dim=(1, 2))
    border = WINDOWS[window].border
    height, width = local.shape[1:]
    weight = mask[:, border : border + height, border : border + width].double()
    return (local * weight).sum(dim=(1, 2)) / weight.sum(dim=(1, 2))
