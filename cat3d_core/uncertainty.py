"""How little a field knows of what a camera sees: rays whose end is uncertain, and places no view has seen."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from cat3d_core.cameras import Cameras
from cat3d_core.rays import image_rays


def ray_entropy(weights: Tensor) -> Tensor:
    """(R,) in [0, 1]: entropy of where a ray ends, from its compositing weights (R, n) and what passes through, over
    that of a ray that may end anywhere (Lee et al. 2022, "Uncertainty guided policy for active robotic 3D
    reconstruction using neural radiance fields")."""
    passed = (1 - weights.sum(-1, keepdim=True)).clamp(min=0)
    share = torch.cat([weights, passed], -1)
    share = share / share.sum(-1, keepdim=True).clamp(min=torch.finfo(share.dtype).tiny)
    return torch.special.entr(share).sum(-1) / math.log(share.shape[-1])


def shown_by(
    depth: Tensor, camera: Cameras, known: Cameras, known_depth: Sequence[Tensor], tolerance: float = 0.05
) -> Tensor:
    """(H, W) int64: how many of the N known views show what a pixel of a camera (one) shows.

    depth (H, W): z-depth along the camera's rays, at any resolution; known_depth: N of them, each of any size, of what
    the known cameras see themselves. A pixel's point is shown by a view whose own depth there is the point's z within
    `tolerance` of it: nothing stands between them.
    """
    height, width = depth.shape
    rays = image_rays(camera, 0, width, height)
    points = rays.origins + depth.reshape(-1, 1).to(rays.origins) * rays.directions
    pixels, z = known.project(points.to(known.intrinsics))
    count = torch.zeros(height * width, dtype=torch.int64)
    for view, seen in enumerate(known_depth):
        size = torch.tensor(seen.shape[::-1]).to(pixels)
        place = (pixels[view] * size / known.size[view].to(pixels)).floor()
        inside = (z[view] > 0) & (place >= 0).all(-1) & (place < size).all(-1)
        column, row = torch.where(inside[:, None], place, 0.0).long().unbind(-1)
        count += inside & ((seen[row, column].to(z) - z[view]).abs() < tolerance * z[view])
    return count.view(height, width)


def unseen(points: Tensor, cameras: Cameras) -> Tensor:
    """(P,) bool: which of the world points (P, 3) are in the image of none of the cameras."""
    pixels, depth = cameras.project(points.to(cameras.intrinsics))
    inside = (depth > 0) & (pixels >= 0).all(-1) & (pixels <= cameras.size[:, None].to(pixels)).all(-1)
    return ~inside.any(0)
