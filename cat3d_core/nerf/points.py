"""Point clouds from rendered depth."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from cat3d_core.cameras import Cameras
from cat3d_core.nerf.render import Render
from cat3d_core.rays import image_rays


class PointCloud(NamedTuple):
    """points (P, 3) and unit normals (P, 3) in the frame of the cameras; colours (P, 3) in [0, 1]."""

    points: Tensor
    colours: Tensor
    normals: Tensor


def surface_mask(
    render: Render, rays_directions: Tensor, min_opacity: float, max_depth: float, min_cosine: float
) -> Tensor:
    """Pixels (H, W) whose median depth is a surface: opaque enough, near enough, and not seen at a grazing angle.

    Depth edges are grazing too: the normals come from depth differences (directions (H * W, 3), any length).
    """
    view = torch.nn.functional.normalize(rays_directions, dim=-1).view(*render.depth.shape, 3)
    cosine = -(render.normals * view).sum(-1)
    return (render.opacity >= min_opacity) & (render.depth <= max_depth) & (cosine >= min_cosine)


def point_cloud(
    renders: Sequence[Render],
    cameras: Cameras,
    min_opacity: float = 0.5,
    max_depth: float = 10.0,
    min_cosine: float = 0.1,
) -> PointCloud:
    """One coloured point per surface pixel of the renders, which may be coarser than the cameras' images.

    Depths and the result are in normalised scene units (map back with the scene's inverse similarity).
    Raises ValueError where the number of renders and cameras differ.
    """
    if len(renders) != len(cameras):
        raise ValueError(
            f"A point cloud needs one camera per render; got {len(renders)} renders, {len(cameras)} cameras."
        )
    parts: list[list[Tensor]] = [[], [], []]
    for index, render in enumerate(renders):
        height, width = render.depth.shape
        rays = image_rays(cameras, index, width, height)
        origins, directions = rays.origins.to(render.depth), rays.directions.to(render.depth)
        keep = surface_mask(render, directions, min_opacity, max_depth, min_cosine).reshape(-1)
        points = origins + render.depth.reshape(-1, 1) * directions
        for part, value in zip(parts, (points, render.image.view(-1, 3), render.normals.view(-1, 3)), strict=True):
            part.append(value[keep])
    return PointCloud(*(torch.cat(part) for part in parts))
