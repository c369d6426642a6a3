"""Lens distortion (OpenCV's model) and the pinhole camera that takes its place."""

from __future__ import annotations

import torch
from torch import Tensor

from flows.errors import InputError

# The largest factor by which undistortion may change the focal length before the coefficients are called implausible.
MAX_ZOOM = 3.0


def distort(xy: Tensor, distortion: Tensor) -> Tensor:
    """Normalised image coordinates (..., 2), x = X/Z, to where the lens puts them; OpenCV's model.

    distortion (5): k1, k2, p1, p2, k3. With r2 = x^2 + y^2: x (1 + k1 r2 + k2 r2^2 + k3 r2^3) + 2 p1 x y
    + p2 (r2 + 2 x^2), and the same for y with p1 and p2 exchanged.
    """
    k1, k2, p1, p2, k3 = distortion.to(xy).unbind(-1)
    x, y = xy.unbind(-1)
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return torch.stack(
        [x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y], -1
    )


def distorted_pixels(pixels: Tensor, new: Tensor, old: Tensor, distortion: Tensor) -> Tensor:
    """Where in the distorted photo the pixel positions (..., 2) of the undistorted image come from."""
    focal, center = new[[0, 1], [0, 1]], new[:2, 2]
    return distort((pixels - center) / focal, distortion) * old[[0, 1], [0, 1]] + old[:2, 2]


def filling_zoom(intrinsics: Tensor, distortion: Tensor, width: int, height: int) -> float:
    """The smallest zoom of the focal lengths for which the image's border comes from inside the photo."""
    t = torch.linspace(0, 1, 257, dtype=torch.float64)
    sides = [torch.stack([t, 0 * t], -1), torch.stack([t, 0 * t + 1], -1), torch.stack([0 * t, t], -1)]
    size = torch.tensor([width, height], dtype=torch.float64)
    border = torch.cat([*sides, torch.stack([0 * t + 1, t], -1)]) * size

    def fills(zoom: float) -> bool:
        new = intrinsics.clone()
        new[0, 0], new[1, 1] = intrinsics[0, 0] * zoom, intrinsics[1, 1] * zoom
        source = distorted_pixels(border, new, intrinsics, distortion)
        # Beyond a lens's fold the model turns back inwards: such a border would come from inside, but wrongly.
        outward = ((source - intrinsics[:2, 2]) * (border - intrinsics[:2, 2])).sum(-1) >= 0
        return bool(((source >= -1e-6) & (source <= size + 1e-6)).all() and outward.all())

    low, high = 1 / MAX_ZOOM, MAX_ZOOM
    if not fills(high):
        raise InputError(
            f"The lens distortion {[round(float(d), 4) for d in distortion]} is implausible for an image of {width} x "
            f"{height} pixels: no zoom up to {MAX_ZOOM:g} makes a pinhole image of it; correct the coefficients."
        )
    for _ in range(40):
        middle = (low + high) / 2
        low, high = (low, middle) if fills(middle) else (middle, high)
    return high
