"""Coordinates of the field: contraction of unbounded space and warping of ray distance (Zip-NeRF section 2,
supplement).

`t` is distance along a ray in normalised scene units (z-depth: ray directions have camera z = 1); `s` in [0, 1] is the
warped distance in which intervals are sampled. All functions are differentiable and finite over every float32
magnitude that they document, forward and backward.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor


def contract(x: Tensor) -> Tensor:
    """Contract points (..., 3) of the whole space into the ball of radius 2 (mip-NeRF 360 eq. 10); identity for |x| <=
    1.

    |x|^2 is clamped to at least 1 before the root, so that value and gradient are exact inside the unit ball and no
    branch produces a NaN. Needs |x| below 1e19 in float32.
    """
    squared = x.square().sum(-1, keepdim=True).clamp_min(1.0)
    return x * ((2.0 * squared.sqrt() - 1.0) / squared)


def contracted_std(x: Tensor, std: Tensor) -> Tensor:
    """Standard deviation (...) of an isotropic Gaussian at x (..., 3) after `contract`: std * det(J)^(1/3)."""
    radius = x.square().sum(-1).clamp_min(1.0).sqrt()
    return std * ((2.0 * radius - 1.0).pow(2.0 / 3.0) / radius.square())


def power_ladder(x: Tensor, p: float, premult: float = 1.0) -> Tensor:
    """Tukey's ladder made smooth (Zip-NeRF supplement): |p-1|/p ((|x'|/|p-1| + 1)^p - 1), x' = premult x, for p <= 1.

    The limits p = 1 (linear), 0 (log1p) and -inf (1 - exp(-x')) are exact. x >= 0.
    """
    x = x * premult
    if p == 1.0:
        return x
    if p == 0.0:
        return x.log1p()
    if p == -math.inf:
        return -torch.expm1(-x)
    scale = abs(p - 1.0)
    return (scale / p) * torch.expm1(p * torch.log1p(x / scale))


def inverse_power_ladder(y: Tensor, p: float, premult: float = 1.0) -> Tensor:
    """Inverse of `power_ladder`. Near the asymptote y itself cannot resolve x: for ray distances use `t_from_s`."""
    if p == 1.0:
        x = y
    elif p == 0.0:
        x = torch.expm1(y)
    elif p == -math.inf:
        x = -torch.log1p(-y)
    else:
        scale = abs(p - 1.0)
        x = scale * torch.expm1(torch.log1p(y * (p / scale)) / p)
    return x / premult


def _check_range(near: float, far: float, p: float) -> None:
    if not 0.0 <= near < far or not math.isfinite(far):
        raise ValueError(f"The ray range needs 0 <= near < far < inf, got near={near}, far={far}.")
    if p > 1.0 or not math.isfinite(p):
        raise ValueError(f"The ray distance curve needs a finite power p <= 1, got {p}.")


def t_from_s(s: Tensor, near: float, far: float, p: float = -1.5, premult: float = 2.0) -> Tensor:
    """Distance t at warped distance s in [0, 1]: the inverse of the normalised power ladder, accurate in float32.

    The ladder is linear in u(t) = (1 + premult t / |p-1|)^p, so u is interpolated between near and far instead of
    inverting the rounded ladder value, whose last float32 step below the asymptote spans t = 8e4 to 1e6. With
    r = u(far)/u(near) and c = near + |p-1|/premult:  t = near + c ((1 - s(1-r))^(1/p) - 1), evaluated by expm1/log1p
    for small s (where the power cancels) and by the power of (1-s) + s r otherwise. Relative error below 1e-6.
    """
    _check_range(near, far, p)
    if p == 1.0:
        return near + s * (far - near)
    offset = near + abs(p - 1.0) / premult
    stretch = (far + abs(p - 1.0) / premult) / offset
    if p == 0.0:
        return near + offset * torch.expm1(s * math.log(stretch))
    ratio = stretch**p
    low = s < 0.5
    small = torch.expm1(torch.log1p(torch.where(low, s, 0.0) * (ratio - 1.0)) / p)
    large = torch.pow(torch.where(low, 1.0, 1.0 - s + s * ratio), 1.0 / p) - 1.0
    return near + offset * torch.where(low, small, large)


def s_from_t(t: Tensor, near: float, far: float, p: float = -1.5, premult: float = 2.0) -> Tensor:
    """Warped distance of t in [near, far]: (P(t) - P(near)) / (P(far) - P(near)) of the power ladder, without
    cancellation."""
    _check_range(near, far, p)
    if p == 1.0:
        return (t - near) / (far - near)
    offset = near + abs(p - 1.0) / premult
    stretch = (far + abs(p - 1.0) / premult) / offset
    logarithm = torch.log1p((t - near) / offset)
    if p == 0.0:
        return logarithm / math.log(stretch)
    return torch.expm1(p * logarithm) / math.expm1(p * math.log(stretch))
