"""Ray intersections with unit shapes and with the wavy ground, in closed form or to machine precision.

Rays are x(t) = origin + t * direction with directions of any length; an affine change of frame keeps t.
"""

from __future__ import annotations

import torch
from torch import Tensor

FAR = float("inf")
NEAR_EPSILON = 1e-4
_TINY = 1e-12
_MARCH_STEPS = 32
_NEWTON_STEPS = 3


def length(vectors: Tensor, dim: int = -1) -> Tensor:
    """Euclidean length along `dim`; for three components several times faster than torch's norm on a CPU."""
    return vectors.square().sum(dim).sqrt()


def _nonzero(x: Tensor) -> Tensor:
    return torch.where(x.abs() < _TINY, torch.full_like(x, _TINY), x)


def _slab(origin: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
    """Entry and exit of [-1, 1]^n along the component axis -2: (..., n, R) -> (..., R) twice."""
    inverse = 1 / _nonzero(direction)
    a, b = (-1 - origin) * inverse, (1 - origin) * inverse
    return torch.minimum(a, b).amax(-2), torch.maximum(a, b).amin(-2)


def _circle(origin: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
    """Entry and exit of |x| <= 1 over the components on axis -2; an empty interval (inf, -inf) for a miss."""
    a = direction.square().sum(-2).clamp(min=_TINY)
    b = (origin * direction).sum(-2)
    # The discriminant from the offset at closest approach: it doesn't cancel for far origins.
    closest = origin - (b / a).unsqueeze(-2) * direction
    discriminant = 1 - closest.square().sum(-2)
    half = (discriminant.clamp(min=0) / a).sqrt()
    miss = discriminant <= 0
    return (-b / a - half).masked_fill(miss, FAR), (-b / a + half).masked_fill(miss, -FAR)


def _first(entry: Tensor, leave: Tensor) -> Tensor:
    return torch.where((entry < leave) & (entry > NEAR_EPSILON), entry, torch.full_like(entry, FAR))


def sphere(origin: Tensor, direction: Tensor) -> Tensor:
    """t of the first hit from outside, inf for none. origin, direction (..., 3, R) in the object frame -> (..., R)."""
    return _first(*_circle(origin, direction))


def box(origin: Tensor, direction: Tensor) -> Tensor:
    """Like `sphere`, for the cube [-1, 1]^3."""
    return _first(*_slab(origin, direction))


def cylinder(origin: Tensor, direction: Tensor) -> Tensor:
    """Like `sphere`, for the capped cylinder |xy| <= 1, |z| <= 1."""
    side, caps = _circle(origin[..., :2, :], direction[..., :2, :]), _slab(origin[..., 2:, :], direction[..., 2:, :])
    return _first(torch.maximum(side[0], caps[0]), torch.minimum(side[1], caps[1]))


def room(origin: Tensor, direction: Tensor) -> Tensor:
    """t where a ray leaves the cube [-1, 1]^3: the wall seen from inside; inf from outside."""
    entry, leave = _slab(origin, direction)
    return torch.where((entry <= 0) & (leave > 0), leave, torch.full_like(leave, FAR))


def _swell(waves: Tensor, flat_radius: Tensor, xy: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Angles (S, K, R) of the waves, their sum (S, R) and the fade (S, R) at xy (S, 2, R)."""
    angle = torch.baddbmm(waves[..., 2:3], waves[..., :2], xy)
    swell = (waves[:, None, :, 3] @ torch.sin(angle))[:, 0]
    r2 = xy.square().sum(1)
    return angle, swell, r2 / (r2 + flat_radius.square()[:, None])


def ground_height(waves: Tensor, flat_radius: Tensor, xy: Tensor) -> Tensor:
    """Height (S, R) of the ground. waves (S, K, 4), flat_radius (S,), xy (S, 2, R)."""
    _, swell, fade = _swell(waves, flat_radius, xy)
    return fade * swell


def ground_gradient(waves: Tensor, flat_radius: Tensor, xy: Tensor) -> Tensor:
    """Slope (S, 2, R) of the ground in x and y; arguments as for `ground_height`."""
    angle, swell, fade = _swell(waves, flat_radius, xy)
    flat = flat_radius.square()[:, None]
    fade_slope = 2 * flat / (xy.square().sum(1) + flat).square()
    slope = (waves[..., 3:] * waves[..., :2]).mT @ torch.cos(angle)
    return fade[:, None] * slope + (fade_slope * swell)[:, None] * xy


def ground(waves: Tensor, flat_radius: Tensor, origin: Tensor, direction: Tensor) -> Tensor:
    """t of the first hit with z = height(x, y) from above, inf for none. origin, direction (S, 3, R) -> (S, R).

    Level ground (no waves) is a plane in closed form. Otherwise: steps that cannot pass the surface, from a bound on
    its slope (sphere tracing, Hart 1996), then Newton's method.
    """
    oz, dz = origin[:, 2], direction[:, 2]
    bound = waves[..., 3].abs().sum(-1)[:, None]
    plane = -oz / _nonzero(dz)
    plane = torch.where((dz < 0) & (plane > 0), plane, torch.full_like(plane, FAR))
    if not bool((waves[..., 3] != 0).any()):
        return plane
    # |grad(fade * swell)| <= sum a |k| + max|fade'| * sum a, and max fade' = 0.65 / flat_radius.
    slope = (waves[..., 3].abs() * waves[..., :2].norm(dim=-1)).sum(-1)[:, None]
    slope = slope + 0.65 * bound / flat_radius[:, None].clamp(min=1e-3)
    speed = slope * length(direction[:, :2], 1) + dz.abs()
    # Start where the ray enters the layer |z| <= bound from above.
    t = ((oz - bound) / (-dz).clamp(min=_TINY)).clamp(min=0)
    never = (oz > bound) & (dz >= 0)
    t = torch.where(never, torch.zeros_like(t), t)
    for _ in range(_MARCH_STEPS):
        height = ground_height(waves, flat_radius, (origin + t[:, None] * direction)[:, :2])
        gap = oz + t * dz - height
        t = t + (gap / speed.clamp(min=_TINY)).clamp(min=0)
    for _ in range(_NEWTON_STEPS):
        point = origin + t[:, None] * direction
        height = ground_height(waves, flat_radius, point[:, :2])
        gradient = ground_gradient(waves, flat_radius, point[:, :2])
        rate = dz - (gradient * direction[:, :2]).sum(1)
        step = (point[:, 2] - height) / torch.where(rate.abs() < 1e-3, torch.full_like(rate, -1e-3), rate)
        t = t - step.clamp(-0.5, 0.5)
    point = origin + t[:, None] * direction
    height = ground_height(waves, flat_radius, point[:, :2])
    close = (point[:, 2] - height).abs() <= 1e-3 * (1 + t * length(direction, 1))
    wavy = torch.where(close & ~never & (t > NEAR_EPSILON), t, torch.full_like(t, FAR))
    return torch.where(bound > 0, wavy, plane)
