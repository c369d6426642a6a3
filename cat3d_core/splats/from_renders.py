"""Splats of any reconstruction, from what it renders: no training, only geometry."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn.functional import normalize

from cat3d_core.cameras import Cameras
from cat3d_core.quaternions import quaternions_from_rotations
from cat3d_core.rays import image_rays, perpendicular_basis
from cat3d_core.reconstruction.render import Render
from cat3d_core.splats.gaussians import Gaussians, harmonics_of_colour

WIDTH = 0.4
"""Standard deviation within the surface, in pixel widths. More closes gaps and blurs: 0.3, 0.4, 0.6 and 0.9 gave 22.6,
23.6, 21.3 and 18.7 dB against the field of a mip360 scene, from 24 views of 64 pixels."""
THICKNESS = 0.1
"""The same along the normal, as a share of that within the surface."""
STEEPEST = 0.6
"""A surface seen at a smaller cosine is stretched no further than for this one."""
OPACITY = 0.9
LEAST_OPACITY = 0.05
SHELL = 30.0
"""Distance (scene units) beyond which a surface counts as background and its Gaussians stand on one shell."""


def from_renders(renders: Sequence[Render], cameras: Cameras, most: int = 200_000) -> Gaussians:
    """At most `most` flat Gaussians, one for the pixels of all renders that fall into one cell of space.

    Each pixel gives a disc at its median depth, across its normal, as large as the pixel there (surfels, Pfister et al.
    2000); what it lets through is background and gives a disc on a far shell. Discs in one cell are merged, the finest
    counting most; cells are as wide as a pixel's footprint at their distance, and wider by as much as `most` asks for.
    The cameras and depths are in normalised scene units; renders may be coarser or finer than the cameras' images.
    Raises ValueError where the numbers of renders and cameras differ or none shows anything.
    """
    if len(renders) != len(cameras) or not len(renders):
        raise ValueError(f"Splats need one camera per render; got {len(renders)} renders, {len(cameras)} cameras.")
    parts = [_discs(render, cameras, index) for index, render in enumerate(renders)]
    means, normals, colours, opacities, widths = (torch.cat(values) for values in zip(*parts, strict=True))
    if not len(means):
        raise ValueError("No render shows anything, so there are no splats to make.")
    cell = 1.0
    while True:
        rows, count = _cells(means, widths, cell)
        if count <= most:
            break
        cell *= max(1.1, (count / most) ** 0.4)
    weight = 1.0 / widths.square()
    total = torch.zeros(count, device=means.device).index_add_(0, rows, weight)

    def merged(values: Tensor) -> Tensor:
        weighted = values * (weight / total[rows])[:, None]
        return torch.zeros((count, values.shape[1]), device=means.device).index_add_(0, rows, weighted)

    opacity, width = merged(torch.stack([opacities, (widths * cell).log()], 1)).unbind(1)
    normal = normalize(merged(normals), dim=-1, eps=1e-12)
    return Gaussians(
        merged(means), quaternions_from_rotations(_frames(normal)),
        torch.stack([width, width, width + math.log(THICKNESS)], -1),
        opacity.clamp(1e-3, 1 - 1e-3).logit(), harmonics_of_colour(merged(colours)),
    )  # fmt: skip


def _discs(render: Render, cameras: Cameras, index: int) -> tuple[Tensor, ...]:
    """means, normals, colours (P, 3), opacities and standard deviations across the normal (P,) of a render's pixels."""
    height, width = render.depth.shape
    camera = cameras[index].resize(width, height)
    rays = image_rays(camera, 0)
    directions, origins = rays.directions.to(render.depth), rays.origins.to(render.depth)
    pixel = WIDTH / camera.intrinsics[0, 0, 0].to(render.depth)
    depth, opacity, colour = render.depth.reshape(-1), render.opacity.reshape(-1), render.image.reshape(-1, 3)
    towards = -normalize(directions, dim=-1)
    shell = SHELL / directions.norm(dim=-1)
    far = depth > shell
    depth = torch.where(far, shell, depth)
    normal = render.normals.reshape(-1, 3)
    known = ~far & (normal.norm(dim=-1) > 0.5)
    normal = torch.where(known[:, None], normal, towards)
    cosine = (normal * towards).sum(-1).clamp_min(STEEPEST)
    # A pixel's image of the surface is as long as 1 / cosine one way only; the disc is round, of the same area.
    surface = origins + depth[:, None] * directions, normal, colour, OPACITY * opacity, pixel * depth / cosine.sqrt()
    behind = (
        origins + shell[:, None] * directions, towards, colour, torch.full_like(opacity, OPACITY), pixel * shell,
    )  # fmt: skip
    shown, through = opacity >= LEAST_OPACITY, ~far & (opacity < 0.5)
    return tuple(torch.cat([a[shown], b[through]]) for a, b in zip(surface, behind, strict=True))


def _cells(means: Tensor, widths: Tensor, cell: float) -> tuple[Tensor, int]:
    """For each disc the number of its cell, and how many cells there are. A cell is `cell` pixels wide where its discs
    are, in steps of powers of two, so that near and far discs have cells of their own."""
    level = (widths * (cell / WIDTH)).log2().round()
    place = (means / level.exp2()[:, None]).floor()
    _, rows = torch.unique(torch.cat([level[:, None], place], 1).long(), dim=0, return_inverse=True)
    return rows, int(rows.max()) + 1


def _frames(normal: Tensor) -> Tensor:
    """(N, 3, 3) rotations whose last columns are unit normals (N, 3)."""
    return torch.cat([perpendicular_basis(normal), normal[..., None, :]], -2).mT
