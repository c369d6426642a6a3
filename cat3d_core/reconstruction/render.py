"""A rendered image with its depth, whatever it was rendered from."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from cat3d_core.rays import Rays


@dataclass(frozen=True)
class Render:
    """A rendered image: image (H, W, 3) in [0, 1]; depth (H, W) median and depth_mean (H, W) expected z-depth in
    normalised scene units; opacity (H, W) in [0, 1]; normals (H, W, 3) unit, world frame, towards the camera, from the
    median depth."""

    image: Tensor
    depth: Tensor
    depth_mean: Tensor
    opacity: Tensor
    normals: Tensor


def normals_from_depth(depth: Tensor, rays: Rays) -> Tensor:
    """Unit normals (H, W, 3) in the world, towards the camera, of the surface of z-depth (H, W) seen along its rays
    (H*W).

    Central differences of the back-projected points, the nearer neighbour at depth edges; 0 where they degenerate.
    """
    height, width = depth.shape
    tiny = torch.finfo(depth.dtype).tiny
    # Relative to the one camera centre, so that close surfaces do not drown in the rounding of its position.
    points = (depth.reshape(-1, 1) * rays.directions).reshape(height, width, 3)

    def tangent(axis: int) -> Tensor:
        step = points.diff(dim=axis)
        edge = torch.full_like(step.narrow(axis, 0, 1), torch.inf)
        after, before = torch.cat([step, edge], axis), torch.cat([edge, step], axis)
        shorter = after.norm(dim=-1, keepdim=True) <= before.norm(dim=-1, keepdim=True)
        # Of unit length, so that their product neither overflows far away nor underflows close by.
        return torch.nn.functional.normalize(torch.where(shorter, after, before), dim=-1, eps=tiny)

    if min(height, width) < 2:
        return torch.zeros_like(points)
    normal = torch.linalg.cross(tangent(0), tangent(1))
    normal = normal / normal.norm(dim=-1, keepdim=True).clamp_min(tiny)
    away = (normal * rays.directions.reshape(height, width, 3)).sum(-1, keepdim=True) > 0
    return torch.where(away, -normal, normal)
