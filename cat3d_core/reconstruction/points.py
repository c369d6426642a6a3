"""Point clouds from rendered depth."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from cat3d_core.cameras import Cameras
from cat3d_core.rays import image_rays
from cat3d_core.reconstruction.render import Render


class PointCloud(NamedTuple):
    """points (P, 3) and unit normals (P, 3) in the frame of the cameras; colours (P, 3) in [0, 1]."""

    points: Tensor
    colours: Tensor
    normals: Tensor


def surface_depth(
    render: Render,
    cameras: Cameras,
    index: int,
    min_opacity: float = 0.5,
    max_depth: float = 10.0,
    min_cosine: float = 0.1,
    max_radius: float = math.inf,
) -> Tensor:
    """Median z-depth (H, W) of camera `index` where the pixel shows a surface, 0 elsewhere.

    A surface is opaque enough, near enough to the camera (max_depth) and to the scene's origin (max_radius), and not
    seen at a grazing angle. What lies between two depths at an edge is grazing too: normals come from depth
    differences. The render may be coarser or finer than the camera's image.
    """
    height, width = render.depth.shape
    rays = image_rays(cameras, index, width, height)
    directions = rays.directions.to(render.depth)
    points = rays.origins.to(render.depth) + render.depth.reshape(-1, 1) * directions
    cosine = -(render.normals.view(-1, 3) * torch.nn.functional.normalize(directions, dim=-1)).sum(-1)
    near = (render.depth <= max_depth) & (points.norm(dim=-1) <= max_radius).view(height, width)
    surface = near & (render.opacity >= min_opacity) & (cosine >= min_cosine).view(height, width)
    return torch.where(surface, render.depth, 0.0)


def point_cloud(
    renders: Sequence[Render],
    cameras: Cameras,
    min_opacity: float = 0.5,
    max_depth: float = 10.0,
    min_cosine: float = 0.1,
    max_radius: float = math.inf,
) -> PointCloud:
    """One coloured point per surface pixel of the renders (see `surface_depth`).

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
        depth = surface_depth(render, cameras, index, min_opacity, max_depth, min_cosine, max_radius).reshape(-1, 1)
        keep = depth[:, 0] > 0
        points = rays.origins.to(depth) + depth * rays.directions.to(depth)
        for part, value in zip(parts, (points, render.image.view(-1, 3), render.normals.view(-1, 3)), strict=True):
            part.append(value[keep])
    return PointCloud(*(torch.cat(part) for part in parts))
