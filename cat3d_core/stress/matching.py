"""The plane sweep's warp and its pooling over photos, reference and kernel."""

from __future__ import annotations

import torch
from torch import Tensor

from cat3d_core.matching.planes import inverse_depth_of, position_of
from cat3d_core.matching.targets import pool
from cat3d_core.matching.warp import pair_maps, project, take, views
from cat3d_core.stress.draw import Draw
from cat3d_core.stress.geometry import cameras_of, pose_of
from cat3d_core.stress.routine import DOUBLE, ROUNDING, SINGLE, Exact, Routine

_SIZE = 64
_NEAREST = 10.0


def _pair_inputs(draw: Draw) -> tuple[Tensor, ...]:
    """Two cameras up to three units apart, any rotations, fields of view of 10 to 130 degrees; inverse depths of four
    pixels from infinity (0) to ten times nearer than the unit distance."""
    k = torch.zeros(2, draw.count, 3, 3, dtype=torch.float64)
    for camera in k:
        camera[:, 0, 0], camera[:, 1, 1] = (draw.log_between(2, 0.25 * _SIZE, 6.0 * _SIZE)).unbind(1)
        camera[:, :2, 2], camera[:, 2, 2] = _SIZE / 2 + draw.between(2, -8, 8), 1
    poses = [pose_of(draw.rotation()[:, 0], draw.between(3, -1.5, 1.5)) for _ in range(2)]
    depth = torch.where(draw.unit(4) < 0.2, 0.0, draw.log_between(4, 1e-4, _NEAREST)).view(-1, 1, 2, 2)
    return k[0], poses[0], k[1], poses[1], depth


def _placed(k: Tensor, pose: Tensor, k2: Tensor, pose2: Tensor, depth: Tensor) -> Tensor:
    """(count, 1, 2, 2, 3): normalised place in the photo, and inverse depth there times the target's depth."""
    target, photo = views(cameras_of(k.double(), pose.double())), views(cameras_of(k2.double(), pose2.double()))
    maps = pair_maps(target, photo[torch.arange(len(k))[:, None]], depth.dtype)
    at = project(maps, depth)
    return torch.cat([at.grid[:, 0], at.inverse_depth[:, 0, ..., None]], -1)


def _placed_reference(k: Tensor, pose: Tensor, k2: Tensor, pose2: Tensor, depth: Tensor) -> Exact:
    """Through the world: pixel to ray, ray to a point at depth 1 / d (times d), point to the photo."""
    centre = torch.tensor([0.25, 0.75], dtype=torch.float64) * _SIZE
    y, x = torch.meshgrid(centre, centre, indexing="ij")
    xy = torch.stack([x, y], -1)
    ray = (xy - k[:, None, None, :2, 2]) / torch.stack([k[:, 0, 0], k[:, 1, 1]], -1)[:, None, None]
    ray = torch.cat([ray, torch.ones_like(ray[..., :1])], -1) @ pose[:, None, :3, :3].mT
    d = depth[:, 0, ..., None]
    point = ray + (pose[:, :3, 3] - pose2[:, :3, 3])[:, None, None] * d  # the world point over its depth
    local = point @ pose2[:, None, :3, :3]
    z = local[..., 2:]
    safe = z.clamp(min=1e-3)
    focal = torch.stack([k2[:, 0, 0], k2[:, 1, 1]], -1)[:, None, None]
    # K comes before the division, since z is clamped in it: what is behind the photo is only kept finite.
    image = (local[..., :2] * focal + z * k2[:, None, None, :2, 2]) / safe
    grid = image / _SIZE * 2 - z / safe
    reach = (local.abs().amax(-1, keepdim=True) + 1) / safe * (1 + focal.amax(-1, keepdim=True) / _SIZE * 2)
    value = torch.cat([grid.clamp(-4, 4), d / safe], -1)[:, None]
    # A rounding of the sums moves a place by what it is worth over z, and again by what z itself lost.
    scale = (reach * (1 + 1 / safe))[:, None].expand_as(value)
    return Exact(value, scale)


def _pool_inputs(draw: Draw) -> tuple[Tensor, ...]:
    """Five photos of six numbers: unseen, seen by one, of equal and of far different weight."""
    hidden = draw.signed(5 * 7, 1e-6, 1e3).view(-1, 5, 7)
    hidden = torch.cat([draw.between(5, -60, 60).view(-1, 5, 1), hidden[..., 1:]], -1)
    return hidden, (draw.unit(5) < draw.unit(1)).double()


def _pooled(hidden: Tensor, valid: Tensor) -> Tensor:
    return pool(hidden[:, :, None], valid.to(hidden.dtype)[:, :, None])[:, 0]


def _pool_reference(hidden: Tensor, valid: Tensor) -> Exact:
    """Sums of powers, photo by photo."""
    zero = torch.zeros(len(hidden), 1, dtype=torch.float64)
    total, seen, first, second = zero, zero, zero, zero
    for m in range(hidden.shape[1]):
        sees = valid[:, m, None]
        weight = sees * (1 / (1 + torch.exp(-hidden[:, m, :1])) + 1e-2)
        x = hidden[:, m, 1:].clamp(min=0)
        total, seen = total + weight, seen + sees / hidden.shape[1]
        first, second = first + weight * x, second + weight * x.square()
    over = 1 / total.clamp(min=1e-2)
    mean = first * over
    variance = second * over - 2 * mean * first * over + mean.square() * total * over
    largest = hidden[..., 1:].clamp(min=0).amax((1, 2))[:, None] + 1
    size = [largest.expand_as(mean), largest.square().expand_as(mean), 5 + 0 * total, 5 + 0 * total]
    return Exact(torch.cat([mean, variance, total, seen], -1), torch.cat(size, -1))


def _read_inputs(draw: Draw) -> tuple[Tensor, ...]:
    return draw.signed(2 * 12, 1e-6, 1e3).view(-1, 2, 3, 4), draw.between(6, -1.5, 1.5).view(-1, 1, 1, 3, 2)


def _read_reference(image: Tensor, grid: Tensor) -> Exact:
    """Bilinear between pixel centres, borders repeated, corner by corner."""
    h, w = image.shape[-2:]
    x = ((grid[..., 0] + 1) / 2 * w - 0.5).clamp(0, w - 1)
    y = ((grid[..., 1] + 1) / 2 * h - 0.5).clamp(0, h - 1)
    out = torch.zeros(len(image), 2, *grid.shape[1:4], dtype=torch.float64)
    row = torch.arange(len(image)).view(-1, 1, 1, 1)
    for j in range(h):
        for i in range(w):
            share = (1 - (x - i).abs()).clamp(min=0) * (1 - (y - j).abs()).clamp(min=0)
            out = out + share[:, None] * image[row[:, 0, 0, 0], :, j, i][:, :, None, None, None]
    return Exact(out, (w + h) * image.abs().amax((1, 2, 3))[:, None, None, None, None])


ROUTINES = [
    Routine(
        "warp.project", "planes at infinity, near ones, points behind the photo", _pair_inputs, _placed,
        _placed_reference, ROUNDING, share=0.5,
    ),
    Routine("warp.take", "inside, on borders and outside", _read_inputs, take, _read_reference, ROUNDING, share=0.2),
    Routine(
        "planes.position_of", "from infinity to the nearest plane and back", lambda draw: (draw.unit(1)[:, 0],),
        lambda t: position_of(inverse_depth_of(t, _NEAREST), _NEAREST), lambda t: Exact(t, torch.ones_like(t)),
        ROUNDING, {DOUBLE: 4e-15, SINGLE: 4e-6}, gradient_scale=lambda t: (torch.ones_like(t),),
    ),
    Routine(
        "targets.pool", "no photo, one, several; weights from nothing to one (the C++ kernel in single precision)",
        _pool_inputs, _pooled, _pool_reference, {DOUBLE: 4e-15, SINGLE: 4e-6}, share=0.5,
    ),
]  # fmt: skip
