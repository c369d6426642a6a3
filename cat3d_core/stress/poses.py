"""The scene's normalisation, alignment, curves on SO(3), distances between views."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from cat3d_core.alignment import rotation_angle_deg, umeyama
from cat3d_core.normalization import Similarity, normalize_scene
from cat3d_core.quaternions import rotation_matrices
from cat3d_core.splines import rotation_spline, so3_exp, so3_log, vector_spline
from cat3d_core.stress.draw import Draw
from cat3d_core.stress.geometry import cameras_of, length, pose_of
from cat3d_core.stress.routine import DOUBLE, ROUNDING, SINGLE, Exact, Routine, each, zero
from cat3d_core.view_selection import pose_distance


def _similarity_inputs(draw: Draw) -> tuple[Tensor, ...]:
    return draw.signed(3), draw.log_between(1, 1e-12, 1e12), draw.rotation()[:, 0], draw.signed(3)


def _similarity(x: Tensor, scale: Tensor, rotation: Tensor, translation: Tensor) -> Tensor:
    """There and back, relative to what was added and taken away again."""
    one = Similarity(float(scale), rotation, translation)
    back = one.inverse().points(one.points(x))
    reach = length(x) + length(translation) / scale[0]
    return (back - x) / reach.clamp_min(torch.finfo(x.dtype).tiny)


def _scene_inputs(draw: Draw) -> tuple[Tensor, ...]:
    """Five cameras that look at one point from distances within a factor of 10, the world anywhere and of any size."""
    unit = draw.log_between(1, 1e-12, 1e12)
    toward = draw.direction(5)
    distance = unit * draw.log_between(5, 0.3, 3.0)
    focus = unit * draw.signed(3, 1e-6, 1e4)
    spin = draw.rotation(5)[..., 0]
    down = torch.linalg.cross(toward, spin)
    helper = torch.eye(3, dtype=torch.float64)[toward.abs().argmin(-1)]
    parallel = length(down)[..., None] < 1e-2
    down = torch.where(parallel, torch.linalg.cross(toward, helper), down)
    down = down / length(down)[..., None]
    rotation = torch.stack([torch.linalg.cross(down, toward), down, toward], -1)
    return pose_of(rotation, focus[:, None] - distance[..., None] * toward), focus, distance


def _scene(pose: Tensor, focus: Tensor, distance: Tensor) -> Tensor:
    """Error of the normalised distances to the looked-at point, and of its place, over what their rounding allows."""
    k = torch.eye(3, dtype=pose.dtype).repeat(5, 1, 1)
    similarity = normalize_scene(cameras_of(k, pose))
    wide = pose.double()
    forward = wide[:, :3, 2]
    spread = (torch.eye(3).double() - forward[:, :, None] * forward[:, None]).sum(0)
    condition = float(torch.linalg.cond(spread))
    reach = (wide[:, :3, 3].abs().amax() / distance.double().mean()).clamp_min(1)
    if similarity.method != "convergence":
        # Views that hardly converge are not believed; what is known then is only that all is finite.
        return (similarity.points(wide[:, :3, 3]).sum() * 0).to(pose.dtype)
    mapped = similarity.points(wide[:, :3, 3])
    radii = length(mapped) - distance.double() / distance.double().mean()
    place = length(similarity.points(focus.double()))
    return (torch.cat([radii, place[None]]).abs().amax() / (reach * condition)).to(pose.dtype)


def _umeyama_inputs(draw: Draw) -> tuple[Tensor, ...]:
    source = draw.normal(18).view(-1, 6, 3) * draw.log_between(1, 1e-12, 1e12)[:, None]
    return source, draw.log_between(1, 1e-12, 1e12), draw.rotation()[:, 0], draw.signed(3, 1e-12, 1e3)


def _umeyama(source: Tensor, scale: Tensor, rotation: Tensor, shift: Tensor) -> Tensor:
    """Largest distance after alignment, over the size of the target and what the points' flatness costs."""
    wide = source.double()
    size = (wide - wide.mean(0)).norm(dim=-1).amax()
    # The shift in units of the target's size: adding a larger one would round the points themselves away.
    exact = scale.double() * wide @ rotation.double().T
    target = exact + shift.double() * scale.double() * size
    found = umeyama(wide, target)
    spread = torch.linalg.svdvals(wide - wide.mean(0))
    flatness = (spread[0] / spread[1]).square()
    error = (found.points(wide) - target).norm(dim=-1).amax() / (scale.double()[0] * size)
    return (error / (flatness * (1 + shift.double().norm()))).to(source.dtype)


def _turn_inputs(draw: Draw) -> tuple[Tensor, ...]:
    return (draw.direction()[:, 0] * draw.log_between(1, 1e-12, math.pi * 0.999),)


def _rotation(w: Tensor) -> Tensor:
    """Rotation vectors (..., 3) -> rotations (..., 3, 3) by way of the quaternion."""
    half = (length(w) / 2)[..., None]
    axis = w / torch.where(half > 0, 2 * half, 1.0)
    return rotation_matrices(torch.cat([half.cos(), half.sin() * axis], -1))


def _so3_exp_reference(w: Tensor) -> Exact:
    angle = length(w)[:, None, None].clamp(max=1.0)
    eye = torch.eye(3, dtype=torch.float64)
    return Exact(_rotation(w), eye + (1 - eye) * angle)


def _angle_deg(w: Tensor) -> Tensor:
    return rotation_angle_deg(torch.eye(3, dtype=w.dtype).expand(len(w), 3, 3), so3_exp(w))


def _angle_deg_reference(w: Tensor) -> Exact:
    angle = length(w)
    # The chord is flat near a half turn: there the angle is known to the root of the rounding, as documented.
    return Exact(torch.rad2deg(angle), torch.rad2deg(angle / (1e-3 + (math.pi - angle).clamp_min(0)).clamp(max=1.0)))


def _spline_inputs(draw: Draw) -> tuple[Tensor, ...]:
    steps = draw.log_between(4, 1e-3, 1e3)
    knots = torch.cat([torch.zeros(draw.count, 1), steps.cumsum(1)], 1)
    return knots, draw.signed(15).view(-1, 5, 3), draw.unit(6)


def _spline(knots: Tensor, values: Tensor, share: Tensor) -> Tensor:
    return vector_spline(knots, values, share * knots[-1])


def _spline_reference(knots: Tensor, values: Tensor, share: Tensor) -> Exact:
    """Hermite form; knot velocities by Lagrange's parabola through three knots, natural at the ends."""
    h = knots.diff(dim=1)[..., None]
    slope = values.diff(dim=1) / h
    inner = (h[:, 1:] * slope[:, :-1] + h[:, :-1] * slope[:, 1:]) / (h[:, 1:] + h[:, :-1])
    first, last = 1.5 * slope[:, :1] - 0.5 * inner[:, :1], 1.5 * slope[:, -1:] - 0.5 * inner[:, -1:]
    velocity = torch.cat([first, inner, last], 1)
    t = share * knots[:, -1:]
    i = (t[:, :, None] >= knots[:, None, 1:-1]).sum(-1)

    def at(x: Tensor) -> Tensor:
        return x.gather(1, i[..., None].expand(-1, -1, x.shape[-1]))

    step = at(h)
    u = (t[..., None] - at(knots[..., None])) / step
    h00, h10, h01, h11 = (1 + 2 * u) * (1 - u) ** 2, u * (1 - u) ** 2, u * u * (3 - 2 * u), u * u * (u - 1)
    a, b = values[:, :-1], values[:, 1:]
    result = h00 * at(a) + h01 * at(b) + step * (h10 * at(velocity[:, :-1]) + h11 * at(velocity[:, 1:]))
    steepest = (velocity.abs().amax((1, 2)) * h.amax((1, 2)) + values.abs().amax((1, 2)))[:, None, None]
    # A time rounds by eps of the last knot, which is many short steps long.
    return Exact(result, steepest * (knots[:, -1] / knots.diff(dim=1).amin(1))[:, None, None])


def _arc_inputs(draw: Draw) -> tuple[Tensor, ...]:
    return draw.rotation()[:, 0], draw.direction()[:, 0] * draw.log_between(1, 1e-9, 3.1), draw.unit(5)


def _arc(first: Tensor, w: Tensor, share: Tensor) -> Tensor:
    pair = torch.stack([first, first @ so3_exp(w)])
    return rotation_spline(torch.tensor([0.0, 1.0], dtype=w.dtype), pair, share)


def _arc_reference(first: Tensor, w: Tensor, share: Tensor) -> Exact:
    value = first[:, None] @ _rotation(share[..., None] * w[:, None])
    # Near a half turn the axis is known to rounding over the remaining angle.
    return Exact(value, (1 / (math.pi - length(w)))[:, None, None, None].clamp_min(1.0))


def _distance_inputs(draw: Draw) -> tuple[Tensor, ...]:
    return (
        pose_of(draw.rotation()[:, 0], draw.signed(3)),
        pose_of(draw.rotation()[:, 0], draw.signed(3)),
        draw.log_between(1, 1e-3, 1e3),
    )


def _distance(a: Tensor, b: Tensor, scale: Tensor) -> Tensor:
    k = torch.eye(3, dtype=a.dtype)[None]
    return pose_distance(cameras_of(k, a[None]), cameras_of(k, b[None]), float(scale))[0, 0]


def _distance_reference(a: Tensor, b: Tensor, scale: Tensor) -> Exact:
    shift = length(a[:, :3, 3] - b[:, :3, 3]) / scale[:, 0]
    turn = length(a[:, :3, 2] - b[:, :3, 2])
    rounding = (length(a[:, :3, 3]) + length(b[:, :3, 3])) / scale[:, 0]
    return Exact(torch.hypot(shift, turn), torch.hypot(rounding, torch.ones_like(turn)))


ROUTINES = [
    Routine(
        "normalization.Similarity", "the inverse undoes it", _similarity_inputs, each(_similarity), zero,
        {DOUBLE: 8e-15}, share=0.2,
    ),
    Routine(
        "normalization.normalize_scene", "the looked-at point becomes the origin, its mean distance 1",
        _scene_inputs, each(_scene), zero, ROUNDING, share=0.05,
    ),
    Routine(
        "alignment.umeyama", "recovers a known similarity from six points",
        _umeyama_inputs, each(_umeyama), zero, {DOUBLE: 2e-14}, share=0.1,
    ),
    Routine(
        "alignment.rotation_angle_deg", "exact for small angles", _turn_inputs, _angle_deg, _angle_deg_reference,
        ROUNDING,
    ),
    Routine(
        "splines.so3_exp", "rotation of a vector, off-diagonal entries exact for the smallest turns",
        _turn_inputs, so3_exp, _so3_exp_reference, ROUNDING,
    ),
    Routine(
        "splines.so3_log", "undoes so3_exp from 1e-12 up to a half turn",
        _turn_inputs, lambda w: so3_log(so3_exp(w)), lambda w: Exact(w, length(w)[:, None]),
        ROUNDING,
    ),
    Routine(
        "splines.vector_spline", "cubic through five knots, steps from 1e-3 to 1e3",
        _spline_inputs, each(_spline), _spline_reference, {DOUBLE: 4e-16, SINGLE: 2e-7}, share=0.1,
    ),
    Routine(
        "splines.rotation_spline", "two knots give the geodesic",
        _arc_inputs, each(_arc), _arc_reference, ROUNDING, share=0.1,
    ),
    Routine(
        "view_selection.pose_distance", "distance of two views in position and direction",
        _distance_inputs, each(_distance), _distance_reference, ROUNDING, share=0.2, floor=1e-16,
    ),
]  # fmt: skip
