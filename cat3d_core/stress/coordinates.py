"""Coordinates of the field: contraction and warped distance."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from cat3d_core.stress.draw import Draw
from cat3d_core.stress.routine import DOUBLE, ROUNDING, SINGLE, Exact, Routine
from cat3d_core.zipnerf import coordinates


def _points(draw: Draw) -> tuple[Tensor, ...]:
    """Points of any magnitude, some with unlike components, some on the unit sphere and just beside it."""
    unlike = draw.signed(3)
    around = draw.direction()[:, 0] * (1 + draw.signed(1, 1e-8, 1e-2))
    along = draw.direction()[:, 0] * draw.magnitude(1)
    kind = draw.unit(1)
    return (torch.where(kind < 0.3, unlike, torch.where(kind < 0.6, around, along)),)


def _contract_reference(x: Tensor) -> Exact:
    """(2 - 1/r) x / r outside the unit ball."""
    largest = x.detach().abs().amax(-1, keepdim=True)
    unit = torch.where(largest > 0, largest, 1.0)
    radius = unit * ((x / unit).square().sum(-1, keepdim=True) + torch.where(largest > 0, 0.0, 1.0)).sqrt()
    outside = radius > 1
    safe = torch.where(outside, radius, 1.0)
    value = torch.where(outside, (2 - 1 / safe) * (x / safe), x)
    return Exact(value, value.detach().abs().amax(-1, keepdim=True))


def _std_inputs(draw: Draw) -> tuple[Tensor, ...]:
    return (*_points(draw), draw.magnitude(1)[:, 0])


def _std_reference(x: Tensor, std: Tensor) -> Tensor:
    """Cube root of the Jacobian's eigenvalues: 1/r^2 along the radius, (2 - 1/r)/r twice across."""
    largest = x.abs().amax(-1).clamp_min(1e-300)
    radius = (largest * (x / largest[:, None]).square().sum(-1).sqrt()).clamp_min(1.0)
    across = (2 - 1 / radius) / radius
    return std * (across * across / (radius * radius)) ** (1 / 3)


def _grown(x: Tensor) -> Tensor:
    """exp(x) - 1 without cancellation in the value or the slope: 2 exp(x/2) sinh(x/2) for small x."""
    half = x.clamp(-1.0, 1.0) / 2
    return torch.where(x.abs() < 1.0, 2 * torch.exp(half) * torch.sinh(half), torch.exp(x.clamp(max=500.0)) - 1)


def _ladder(p: float, premult: float) -> Callable[[Tensor], Tensor]:
    """The definition, the power by its exponential."""

    def exact(x: Tensor) -> Tensor:
        y = x * premult
        if p == 1.0:
            return y
        if p == 0.0:
            return torch.log1p(y)
        if p == -math.inf:
            return -_grown(-y)
        c = abs(p - 1)
        return c / p * _grown(p * torch.log1p(y / c))

    return exact


def _inverse_ladder(p: float) -> Callable[[Tensor], Exact]:
    """x itself is what comes out of x -> ladder -> inverse; near the asymptote the rounding of y is amplified."""

    def exact(x: Tensor) -> Exact:
        if p == 1.0:
            return Exact(x, x)
        if p == 0.0:
            return Exact(x, (1 + x) * torch.log1p(x) + x)
        if p == -math.inf:
            return Exact(x, x + torch.expm1(x))
        c = abs(p - 1)
        slope = (1 + x / c) ** (p - 1)
        return Exact(x, x + c / abs(p) * torch.expm1(p * torch.log1p(x / c)).abs() / slope)

    return exact


_NEAR, _FAR, _PREMULT = 0.1, 1e6, 2.0


def _warp_inputs(draw: Draw) -> tuple[Tensor, ...]:
    """Warped distances: uniform, next to both ends, and the ends themselves."""
    s = draw.unit(1)[:, 0]
    tiny = draw.magnitude(1, 1e-12, 0.5)[:, 0]
    kind = draw.unit(1)[:, 0]
    return (torch.where(kind < 0.4, s, torch.where(kind < 0.7, tiny, 1 - tiny)),)


def _t_reference(near: float, far: float, p: float) -> Callable[[Tensor], Exact]:
    """Interpolate log(1 + t/c) (p = 0) or its power; small s by the series-free form near + c (exp(log u / p) - 1)."""

    def exact(s: Tensor) -> Exact:
        if p == 1.0:
            return Exact(near + s * (far - near), near + s * (far - near))
        c = near + abs(p - 1) / _PREMULT
        ratio = (far + abs(p - 1) / _PREMULT) / c
        if p == 0.0:
            exponent = s * math.log(ratio)
        else:
            share = s * -math.expm1(p * math.log(ratio))  # 1 - u, exact for small s
            rest = (1 - s) + s * math.exp(p * math.log(ratio))  # u, exact for s near 1
            exponent = torch.where(share < 0.5, torch.log1p(-share.clamp(max=0.5)), torch.log(rest)) / p
        value = near + c * _grown(exponent)
        return Exact(value, value.detach().abs())

    return exact


def _round_trip(near: float, far: float, p: float) -> Callable[[Tensor], Tensor]:
    def call(s: Tensor) -> Tensor:
        return coordinates.s_from_t(coordinates.t_from_s(s, near, far, p), near, far, p)

    return call


def _ladders() -> list[Routine]:
    rows = []
    for p, premult in ((-1.5, 2.0), (-0.25, 1e4), (0.0, 1.0), (0.5, 1.0), (-math.inf, 1.0)):
        rows.append(
            Routine(
                f"coordinates.power_ladder[{p:g}]", "any distance from 0 to 1e12, value and slope",
                lambda draw: (draw.magnitude(1)[:, 0],),
                lambda x, p=p, m=premult: coordinates.power_ladder(x, p, m), _ladder(p, premult),
                ROUNDING, ROUNDING,
                # Where the curve is flat, the slope is known to rounding of the slope at 0 (expm1's is y + 1).
                gradient_scale=lambda x, m=premult: (torch.full_like(x, m),),
            )
        )  # fmt: skip
        rows.append(
            Routine(
                f"coordinates.inverse_power_ladder[{p:g}]", "undoes the ladder as far as its rounding allows",
                lambda draw: (draw.magnitude(1, 1e-12, 3.0)[:, 0],),
                lambda x, p=p: coordinates.inverse_power_ladder(coordinates.power_ladder(x, p), p),
                _inverse_ladder(p), ROUNDING,
            )
        )  # fmt: skip
    return rows


def _warps() -> list[Routine]:
    rows = []
    for near, far, p in ((0.0, 1e6, -1.5), (0.1, 1e6, -1.5), (0.0, 1e12, -1.5), (0.2, 1e3, 0.0), (1e-3, 10.0, 1.0)):
        name = f"{near:g}..{far:g},p={p:g}"
        rows.append(
            Routine(
                f"coordinates.t_from_s[{name}]", "distance at warped distance, relative error below 1e-6",
                _warp_inputs, lambda s, a=near, b=far, p=p: coordinates.t_from_s(s, a, b, p),
                _t_reference(near, far, p), {DOUBLE: 2e-14, SINGLE: 2e-6}, {SINGLE: 4e-6},
            )
        )  # fmt: skip
        rows.append(
            Routine(
                f"coordinates.s_from_t[{name}]", "undoes t_from_s to rounding of s",
                _warp_inputs, _round_trip(near, far, p), lambda s: Exact(s, torch.ones_like(s)),
                ROUNDING,
            )
        )  # fmt: skip
    return rows


ROUTINES = [
    Routine(
        "coordinates.contract", "the whole space, value and gradient",
        _points, coordinates.contract, _contract_reference, ROUNDING,
        {DOUBLE: 1e-14, SINGLE: 4e-6},
        gradient_scale=lambda x: (1 / x.norm(dim=-1).clamp_min(1.0),),
    ),
    Routine(
        "coordinates.contracted_std", "the whole space", _std_inputs, coordinates.contracted_std, _std_reference,
        {DOUBLE: 1e-14, SINGLE: 2e-6},
    ),
    *_ladders(),
    *_warps(),
]  # fmt: skip
