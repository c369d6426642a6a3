"""Lens distortion (OpenCV's models) and the pinhole camera that takes its place."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from flows.errors import InputError

# The largest factor by which undistortion may change the focal length before the coefficients are called implausible.
MAX_ZOOM = 3.0
# What of a fisheye image a pinhole image can show: beyond this angle from the axis it would be stretched without bound.
MAX_FISHEYE_ANGLE = math.radians(65)


def distort(xy: Tensor, distortion: Tensor, fisheye: bool = False) -> Tensor:
    """Normalised image coordinates (..., 2), x = X/Z, to where the lens puts them; OpenCV's models.

    distortion (5 or 8): k1, k2, p1, p2, k3, and k4, k5, k6 of the rational model. With r2 = x^2 + y^2:
    x (1 + k1 r2 + k2 r2^2 + k3 r2^3) / (1 + k4 r2 + k5 r2^2 + k6 r2^3) + 2 p1 x y + p2 (r2 + 2 x^2), and the same for y
    with p1 and p2 exchanged. fisheye: the four numbers are k1 to k4 of the equidistant model: a ray at the angle theta
    from the axis is at the radius theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8).
    """
    c = distortion.to(xy).unbind(-1)
    x, y = xy.unbind(-1)
    r2 = x * x + y * y
    if fisheye:
        radius = r2.sqrt()
        theta = torch.atan(radius)
        t2 = theta * theta
        bent = theta * (1 + t2 * (c[0] + t2 * (c[1] + t2 * (c[2] + t2 * c[3]))))
        return xy * torch.where(radius > 1e-9, bent / radius.clamp(min=1e-9), torch.ones_like(radius))[..., None]
    k1, k2, p1, p2, k3 = c[:5]
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    if len(c) == 8:
        radial = radial / (1 + r2 * (c[5] + r2 * (c[6] + r2 * c[7])))
    return torch.stack(
        [x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y], -1
    )


def distorted_pixels(pixels: Tensor, new: Tensor, old: Tensor, distortion: Tensor, fisheye: bool = False) -> Tensor:
    """Where in the distorted photo the pixel positions (..., 2) of the undistorted image come from."""
    focal, center = new[[0, 1], [0, 1]], new[:2, 2]
    return distort((pixels - center) / focal, distortion, fisheye) * old[[0, 1], [0, 1]] + old[:2, 2]


def filling_zoom(intrinsics: Tensor, distortion: Tensor, width: int, height: int, fisheye: bool = False) -> float:
    """The smallest zoom of the focal lengths for which the image's border comes from inside the photo.

    Of a fisheye lens the corners are also at most MAX_FISHEYE_ANGLE from the axis.
    """
    t = torch.linspace(0, 1, 257, dtype=torch.float64)
    sides = [torch.stack([t, 0 * t], -1), torch.stack([t, 0 * t + 1], -1), torch.stack([0 * t, t], -1)]
    size = torch.tensor([width, height], dtype=torch.float64)
    border = torch.cat([*sides, torch.stack([0 * t + 1, t], -1)]) * size
    focal, center = intrinsics[[0, 1], [0, 1]], intrinsics[:2, 2]

    def fills(zoom: float) -> bool:
        new = intrinsics.clone()
        new[[0, 1], [0, 1]] = focal * zoom
        source = distorted_pixels(border, new, intrinsics, distortion, fisheye)
        if fisheye and (((border - center) / (focal * zoom)).norm(dim=-1) > math.tan(MAX_FISHEYE_ANGLE)).any():
            return False
        # Beyond a lens's fold the model turns back inwards: such a border would come from inside, but wrongly.
        outward = ((source - center) * (border - center)).sum(-1) >= 0
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
