"""The first Gaussians, from the views alone: along rays of their pixels, at the depths on which other views agree."""

from __future__ import annotations

import torch
from torch import Tensor

from cat3d_core.rays import Rays
from cat3d_core.reconstruction.views import Views, draw_views
from cat3d_core.splats.config import SplatConfig
from cat3d_core.splats.gaussians import Gaussians, harmonics_of_colour

DEPTHS = 48
"""Depths that are tried along a ray, evenly spaced in disparity."""
OTHERS = 8
"""Views in which they are tried."""
UNSEEN = 0.15
"""Difference (mean over the channels) that counts where a view does not show the point."""
OUTLIER = 0.3
"""Largest difference that counts: behind an edge anything can be."""
CHUNK = 2048


def start(views: Views, config: SplatConfig, generator: torch.Generator) -> Gaussians:
    """`config.start` Gaussians: round, grey where nothing is known, as wide as the pixels that each stands for.

    A plane sweep (Collins 1996) over single rays: of each drawn pixel the depth is taken at which other views show the
    most similar colour, unless the views know it. That is often wrong, and better than a depth at random. A share of
    them stands on a far shell.
    """
    device = views.pixels.device
    count = config.start
    view = draw_views(views, count, config.captured_share, generator)
    number = torch.rand(count, generator=generator, device=device, dtype=torch.float64)
    xy = views.pixel(view, (number * views.counting[view]).long().clamp_max(views.counting[view] - 1).clamp_min(0))
    seen = views.batch(view, xy, 1)
    colour = seen.rgb
    rays = views.pinholes.rays(view, xy + 0.5)
    jitter = torch.rand((count, DEPTHS), generator=generator, device=device)
    share = (torch.arange(DEPTHS, device=device) + jitter) / DEPTHS
    depths = 1.0 / (1.0 / config.near + share * (1.0 / config.far - 1.0 / config.near))
    others = _others(views, generator)
    depth = torch.cat(
        [
            _agreeing(views, others, Rays(*(part[rows] for part in rays)), view[rows], colour[rows], depths[rows])
            for rows in torch.arange(count, device=device).split(CHUNK)
        ]
    )
    if seen.inverse_depth is not None and seen.inverse_depth_weight is not None:
        known = seen.inverse_depth_weight > 0.5
        depth = torch.where(known, 1.0 / seen.inverse_depth.clamp(1.0 / config.far, 1.0 / config.near), depth)
    shell = torch.rand(count, generator=generator, device=device) < config.shell
    depth = torch.where(shell, config.far, depth)
    pixels = views.counting.sum() / count  # that each stands for
    focal = views.cameras.intrinsics[view, 0, 0]
    width = (0.5 * depth / focal * pixels.clamp_min(1.0).sqrt()) * torch.where(shell, 2.0, 1.0)
    opacity = torch.full_like(width, config.start_opacity)
    quaternions = torch.zeros((count, 4), device=device)
    quaternions[:, 0] = 1.0
    return Gaussians(
        rays.origins + depth[:, None] * rays.directions, quaternions, width.log()[:, None].repeat(1, 3),
        opacity.logit(), harmonics_of_colour(colour, config.degree),
    )  # fmt: skip


def _others(views: Views, generator: torch.Generator) -> Tensor:
    """Up to OTHERS views at random, captured ones first."""
    order = torch.randperm(len(views), generator=generator, device=views.pixels.device)
    order = order[(~views.captured[order]).to(torch.uint8).argsort(stable=True)]
    return order[:OTHERS]


def _agreeing(views: Views, others: Tensor, rays: Rays, view: Tensor, colour: Tensor, depths: Tensor) -> Tensor:
    """(R,) of depths (R, D) along rays of pixels (R,) of views (R,) with colours (R, 3) the one with the least mean
    difference of colour in other views."""
    points = rays.origins[:, None] + depths[..., None] * rays.directions[:, None]
    pixels, z = views.cameras[others].project(points.reshape(-1, 3))
    total = torch.zeros_like(depths)
    for row, other in enumerate(others):
        xy, size = pixels[row].floor(), views.size[other]
        seen = (z[row] > 0) & (xy >= 0).all(-1) & (xy < size).all(-1)
        at = torch.minimum(xy.clamp_min(0), size - 1).long()
        found = views.batch(other.expand(len(at)), at, 1)
        difference = (found.rgb.view(*depths.shape, 3) - colour[:, None]).abs().mean(-1).clamp_max(OUTLIER)
        known = (seen & (found.valid > 0)).view_as(depths) & (view != other)[:, None]
        total = total + torch.where(known, difference, UNSEEN)
    best = total.argmin(1, keepdim=True)
    return depths.gather(1, best)[:, 0]
