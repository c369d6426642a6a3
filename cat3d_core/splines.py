"""Smooth interpolating curves through positions and rotations.

Positions and rotations share one construction: a cubic through the knots whose knot velocities are those of the
parabola through the neighbours (non-uniform Catmull-Rom), with natural ends. On SO(3) the cubic is the cumulative
Bezier form of Kim, Kim and Shin, 'A general construction scheme for unit quaternion curves' (SIGGRAPH 1995):
R(t) = R_i exp(b1 w1) exp(b2 w2) exp(b3 w3). Both are C1, go through every knot, and for two knots become the
straight line and the geodesic. Nothing is interpolated in Euler angles or by matrix blending, so nothing flips.
"""

from __future__ import annotations

import torch
from torch import Tensor

# Within this of a half turn (as the quaternion's real part) both ways round are equally long; see `so3_log`.
_HALF_TURN = 1e-5


def so3_exp(w: Tensor) -> Tensor:
    """Rotation vectors (..., 3) in radians -> rotations (..., 3, 3) (Rodrigues)."""
    angle = w.norm(dim=-1)[..., None, None]
    zero = torch.zeros_like(w[..., 0])
    x, y, z = w.unbind(-1)
    skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(*w.shape[:-1], 3, 3)
    first = torch.sinc(angle / torch.pi)
    second = 0.5 * torch.sinc(angle / (2 * torch.pi)) ** 2
    return torch.eye(3, dtype=w.dtype, device=w.device) + first * skew + second * (skew @ skew)


def so3_log(rotation: Tensor) -> Tensor:
    """Rotations (..., 3, 3) -> rotation vectors (..., 3) of length at most pi.

    At a half turn the axis has two signs; the one that turns about +y (a camera's down axis: a turn to the right)
    is taken, then +x, then +z, so that rounding cannot choose the way round.
    """
    m = rotation
    trace = m[..., 0, 0] + m[..., 1, 1] + m[..., 2, 2]
    diagonal = torch.stack([trace, m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]], -1)
    # Rows of the symmetric matrix 4 q q^T, q = (w, x, y, z); the row of the largest component is well conditioned.
    wx, wy, wz = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    xy, xz, yz = m[..., 0, 1] + m[..., 1, 0], m[..., 0, 2] + m[..., 2, 0], m[..., 1, 2] + m[..., 2, 1]
    square = [1 + trace] + [1 - trace + 2 * m[..., i, i] for i in range(3)]
    rows = torch.stack(
        [
            torch.stack([square[0], wx, wy, wz], -1),
            torch.stack([wx, square[1], xy, xz], -1),
            torch.stack([wy, xy, square[2], yz], -1),
            torch.stack([wz, xz, yz, square[3]], -1),
        ],
        -2,
    )
    best = diagonal.argmax(-1)[..., None, None].expand(*rows.shape[:-2], 1, 4)
    q = rows.gather(-2, best)[..., 0, :]
    q = q / q.norm(dim=-1, keepdim=True)
    real, imaginary = q[..., :1], q[..., 1:]
    preference = (imaginary[..., 1:2] * 1e4 + imaginary[..., 0:1] * 1e2 + imaginary[..., 2:3]).sign()
    sign = torch.where(real.abs() < _HALF_TURN, preference, real.sign())
    sign = torch.where(sign == 0, torch.ones_like(sign), sign)
    real, imaginary = real * sign, imaginary * sign
    size = imaginary.norm(dim=-1, keepdim=True)
    factor = torch.where(size > 1e-12, 2 * torch.atan2(size, real) / size.clamp(min=1e-300), 2 / real.clamp(min=0.5))
    return imaginary * factor


def rotation_angle(a: Tensor, b: Tensor) -> Tensor:
    """Angle in radians between rotations (..., 3, 3), accurate at both ends of [0, pi]."""
    return so3_log(a.transpose(-1, -2) @ b).norm(dim=-1)


def _knot_velocities(slopes: Tensor, steps: Tensor) -> Tensor:
    """Slopes (K-1, 3) of the segments -> velocities (K, 3) at the knots: parabolic inside, natural at the ends."""
    if len(slopes) == 1:
        return slopes.expand(2, 3)
    before, after = steps[:-1, None], steps[1:, None]
    inner = (after * slopes[:-1] + before * slopes[1:]) / (before + after)
    return torch.cat([(3 * slopes[:1] - inner[:1]) / 2, inner, (3 * slopes[-1:] - inner[-1:]) / 2])


def _locate(knots: Tensor, t: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Segment number, its length, and the fraction in [0, 1] of each t."""
    segment = (torch.searchsorted(knots, t.contiguous(), right=True) - 1).clamp(0, len(knots) - 2)
    step = knots[segment + 1] - knots[segment]
    return segment, step, ((t - knots[segment]) / step).clamp(0, 1)


def _check_knots(knots: Tensor, values: Tensor) -> None:
    if len(knots) != len(values) or len(knots) < 2 or not bool((knots.diff() > 0).all()):
        raise ValueError(
            f"A spline needs at least two knots with strictly increasing times, one value each; got {len(knots)} times "
            f"and {len(values)} values. Merge coincident cameras first."
        )


def vector_spline(knots: Tensor, values: Tensor, t: Tensor) -> Tensor:
    """Cubic through values (K, 3) at times knots (K,), at times t (T,) -> (T, 3). Times outside are clamped.

    Raises ValueError for fewer than two knots or times that do not increase.
    """
    _check_knots(knots, values)
    steps = knots.diff()
    velocity = _knot_velocities(values.diff(dim=0) / steps[:, None], steps)
    i, step, u = _locate(knots, t)
    step, u = step[:, None], u[:, None]
    b1, b2, b3 = 1 - (1 - u) ** 3, u * u * (3 - 2 * u), u**3
    w1, w3 = step * velocity[i] / 3, step * velocity[i + 1] / 3
    return values[i] + b1 * w1 + b2 * (values[i + 1] - values[i] - w1 - w3) + b3 * w3


def rotation_spline(knots: Tensor, rotations: Tensor, t: Tensor) -> Tensor:
    """C1 curve on SO(3) through rotations (K, 3, 3) at times knots (K,), at times t (T,) -> (T, 3, 3).

    Moves with the world: the curve through G R_i is G times the curve through R_i. Raises as `vector_spline`.
    """
    _check_knots(knots, rotations)
    steps = knots.diff()
    relative = rotations[:-1].transpose(1, 2) @ rotations[1:]
    # The log of R_i^T R_{i+1} is the same vector in both cameras' frames, so neighbouring slopes can be averaged.
    velocity = _knot_velocities(so3_log(relative) / steps[:, None], steps)
    w1, w3 = steps[:, None] * velocity[:-1] / 3, steps[:, None] * velocity[1:] / 3
    w2 = so3_log(so3_exp(-w1) @ relative @ so3_exp(-w3))
    i, _, u = _locate(knots, t)
    u = u[:, None]
    b1, b2, b3 = 1 - (1 - u) ** 3, u * u * (3 - 2 * u), u**3
    return rotations[i] @ so3_exp(b1 * w1[i]) @ so3_exp(b2 * w2[i]) @ so3_exp(b3 * w3[i])


def shortest_order(distance: Tensor) -> list[int]:
    """Order in which to visit K places along a short open path, from distances (K, K). Starts at its lower-numbered
    end. Nearest neighbour from every start, then 2-opt; meant for tens of places."""
    count = len(distance)
    if count <= 2:
        return list(range(count))
    d = distance.tolist()

    def length(order: list[int]) -> float:
        return sum(d[a][b] for a, b in zip(order, order[1:], strict=False))

    def from_start(start: int) -> list[int]:
        order, left = [start], set(range(count)) - {start}
        while left:
            order.append(min(left, key=lambda j: (d[order[-1]][j], j)))
            left.remove(order[-1])
        return order

    best = min((from_start(s) for s in range(count)), key=length)
    improved = True
    while improved:
        improved = False
        for i in range(count - 1):
            for j in range(i + 1, count):
                candidate = best[:i] + best[i : j + 1][::-1] + best[j + 1 :]
                if length(candidate) < length(best) - 1e-9 * (1 + length(best)):
                    best, improved = candidate, True
    return best if best[0] < best[-1] else best[::-1]


def even_parameters(step_lengths: Tensor, t: Tensor, count: int, closed: bool = False) -> Tensor:
    """`count` parameters at equal arc length, given lengths (T-1,) of the steps between dense parameters t (T,).

    closed: the end is the start again and is left out. A path of no length gives equal parameter steps.
    """
    along = torch.cat([step_lengths.new_zeros(1), step_lengths.cumsum(0)])
    ends = count if closed else max(count - 1, 1)
    fraction = torch.arange(count, dtype=t.dtype, device=t.device) / ends
    if along[-1] <= 0:
        return t[0] + fraction * (t[-1] - t[0])
    target = fraction * along[-1]
    i = (torch.searchsorted(along, target.contiguous(), right=True) - 1).clamp(0, len(t) - 2)
    length = (along[i + 1] - along[i]).clamp(min=torch.finfo(along.dtype).tiny)
    return t[i] + (t[i + 1] - t[i]) * ((target - along[i]) / length).clamp(0, 1)
