"""Volume rendering: rounds of resampling along rays, compositing, whole images."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from cat3d_core.cameras import Cameras
from cat3d_core.rays import Rays, image_rays
from cat3d_core.reconstruction.render import Render, normals_from_depth
from cat3d_core.uncertainty import ray_entropy
from cat3d_core.zipnerf import ray_intervals, stepfun
from cat3d_core.zipnerf.config import ZipNerfConfig
from cat3d_core.zipnerf.coordinates import t_from_s
from cat3d_core.zipnerf.field import Field, GridDensity
from cat3d_core.zipnerf.frustums import grid_samples
from cat3d_core.zipnerf.gradients import scale_gradient


@dataclass(frozen=True)
class Round:
    """One sampling round: edges in warped distance s and in distance t (R, n+1), weights (R, n)."""

    s: Tensor
    t: Tensor
    weights: Tensor


@dataclass(frozen=True)
class RayRender:
    """rgb (R, 3), opacity (R,), and the rounds (the final one last) from which depths and losses are taken."""

    rgb: Tensor
    opacity: Tensor
    rounds: list[Round]


class Part(NamedTuple):
    """Intervals that were queried together: `rows` of the rays (None: all), a range of intervals, their hidden units
    (rows, range, width)."""

    rows: Tensor | None
    intervals: slice
    hidden: Tensor


def _lengths(t: Tensor, directions: Tensor) -> Tensor:
    """Lengths (R, n) of intervals with edges t (R, n+1) along directions (R, 3) of any length."""
    return (t[..., 1:] - t[..., :-1]) * directions.norm(dim=-1, keepdim=True)


def weights_from_density(density: Tensor, t: Tensor, directions: Tensor) -> Tensor:
    """Compositing weights (R, n) = alpha * transmittance of intervals with edges t (R, n+1) along directions (R, 3)."""
    return ray_intervals.weights(density, _lengths(t, directions))


def _spread(values: Tensor, rows: Tensor | None, count: int) -> Tensor:
    """`values` (K, ...) of the given rays among `count`; the others get 0."""
    return values if rows is None else values.new_zeros((count, *values.shape[1:])).index_put((rows,), values)


def query_rays(
    grid: GridDensity, positions: Tensor, std: Tensor, lengths: Tensor, bound: float, groups: int
) -> tuple[Tensor, list[Part]]:
    """Density (R, N) of intervals with these samples (R, N, S, 3), (R, N, S) and lengths (R, N), and what was queried.

    bound > 0: goes from front to back in `groups` and leaves rays out once less than this share of their light is
    left; density is 0 there. The colour and, since every gradient behind is scaled by the light that is left, its
    gradients change by at most that share.
    """
    count, intervals = lengths.shape
    if not bound:
        density, hidden = grid(positions, std)
        return density, [Part(None, slice(None), hidden)]
    edges = [round(intervals * i / groups) for i in range(groups + 1)]
    depth, rows = torch.zeros_like(lengths[:, 0]), None
    densities, parts = [], []
    for first, last in itertools.pairwise(edges):
        part = slice(first, last)
        if first:
            rows = (depth < -math.log(bound)).nonzero()[:, 0]
            if not len(rows):
                densities.append(torch.zeros_like(lengths[:, first:]))
                break
        density, hidden = grid(*(x[:, part] if rows is None else x[rows, part] for x in (positions, std)))
        densities.append(_spread(density, rows, count))
        parts.append(Part(rows, part, hidden))
        depth = depth + (densities[-1].detach() * lengths[:, part]).sum(1)
    return torch.cat(densities, 1), parts


def near_gradient_scale(t: Tensor, directions: Tensor) -> Tensor:
    """min(1, distance^2) (R, n) of the middles of intervals with edges t (R, n+1), in scene units: a camera sees what
    is near it with a density of rays that falls with the square of the distance (Philip and Deschaintre 2023)."""
    middle = 0.5 * (t[..., 1:] + t[..., :-1]) * directions.norm(dim=-1, keepdim=True)
    return middle.clamp_max(1.0).square()


def composite(
    field: Field, directions: Tensor, weights: Tensor, parts: list[Part], scale: Tensor | None = None
) -> Tensor:
    """rgb (R, 3): the colours of the queried intervals, weighted (R, N); their gradients times `scale` (R, N)."""
    colours = []
    for rows, intervals, hidden in parts:
        seen = slice(None) if rows is None else rows
        colour = field.colour(hidden, directions[seen])
        if scale is not None:
            colour = scale_gradient(colour, scale[seen, intervals, None])
        colours.append(_spread((weights[seen, intervals, None] * colour).sum(1), rows, len(weights)))
    return colours[0] if len(colours) == 1 else torch.stack(colours).sum(0)


def render_rays(
    field: Field,
    rays: Rays,
    anneal: float = 1.0,
    generator: torch.Generator | None = None,
    train_proposals: bool = True,
    config: ZipNerfConfig | None = None,
) -> RayRender:
    """Render rays. With a generator (training): jittered samples, random spirals and a random grey background per ray.

    anneal in [0, 1] is the exponent of the weights that steer the next round (mip-NeRF 360 sec. 4). Distances carry no
    gradient (Zip-NeRF's stop_level_grad).
    """
    config = config or field.config
    count = len(rays.origins)
    s = torch.tensor([0.0, 1.0], device=rays.origins.device).expand(count, 2)
    logits = torch.zeros_like(s[:, :1])
    rounds: list[Round] = []
    parts: list[Part] = []
    scale: Tensor | None = None
    for index, samples in enumerate(config.samples):
        s = ray_intervals.sample_intervals(s, logits, samples, generator)
        t = t_from_s(s, config.near, config.far, config.distance_power, config.distance_premult)
        trained = torch.is_grad_enabled() and (train_proposals or index == config.rounds - 1)
        # A proposal that trains has to be seen whole: where it is 0, its loss would be unbounded.
        skip = 0.0 if trained and index < config.rounds - 1 else config.skip_transmittance
        with torch.set_grad_enabled(trained):
            positions, std = grid_samples(rays, t, config.multisamples, generator)
            lengths = _lengths(t, rays.directions)
            density, parts = query_rays(field.grids[index], positions, std, lengths, skip, config.skip_groups)  # type: ignore[arg-type]
            if trained and config.near_gradient:
                scale = near_gradient_scale(t, rays.directions)
                density = scale_gradient(density, scale)
            weights = ray_intervals.weights(density, lengths)
        rounds.append(Round(s, t, weights))
        # The smallest normal number, not 0: a ray without any weight keeps finite logits.
        logits = anneal * weights.detach().clamp_min(torch.finfo(weights.dtype).tiny).log()
    rgb = composite(field, rays.directions, rounds[-1].weights, parts, scale)
    opacity = rounds[-1].weights.sum(1)
    low, high = config.background
    if generator is None:
        grey = torch.full_like(opacity, 0.5 * (low + high))
    else:
        grey = low + (high - low) * torch.rand(count, generator=generator, device=opacity.device)
    return RayRender(rgb + ((1.0 - opacity).clamp_min(0.0) * grey)[:, None], opacity, rounds)


def expected_depth(final: Round) -> Tensor:
    """Mean z-depth (R,) over the weights; rays without weight get the far end."""
    total = final.weights.sum(1)
    middle = 0.5 * (final.t[:, 1:] + final.t[:, :-1])
    mean = (final.weights * middle).sum(1) / total.clamp_min(torch.finfo(total.dtype).tiny)
    return torch.where(total > 0, mean.clamp(final.t[:, 0], final.t[:, -1]), final.t[:, -1])


@torch.no_grad()
def render_image(
    field: Field,
    cameras: Cameras,
    view_index: int,
    config: ZipNerfConfig | None = None,
    resolution_scale: float = 1.0,
    chunk: int = 4096,
    on_progress: Callable[[float], None] | None = None,
) -> Render:
    """Render one camera (normalised scene) on the field's device, `chunk` rays at a time, at a scaled resolution.

    The depth is z-depth in normalised scene units. `on_progress` is called with the finished share; an exception that
    it raises stops the rendering. `config`: how to sample the rays (samples, multisamples, near, far, background); the
    field's own by default, for example fewer samples for a preview.
    """
    width, height = (max(1, round(float(side) * resolution_scale)) for side in cameras.size[view_index])
    rays = image_rays(cameras, view_index, width, height)
    parts = []
    for out, share in _render_chunks(field, rays, chunk, config):
        last = out.rounds[-1]
        parts.append((out.rgb, out.opacity, stepfun.quantile(last.t, last.weights, 0.5), expected_depth(last)))
        if on_progress is not None:
            on_progress(share)
    rgb, opacity, median, mean = (torch.cat(values) for values in zip(*parts, strict=True))
    depth = median.view(height, width)
    return Render(
        image=rgb.view(height, width, 3).clamp(0.0, 1.0),
        depth=depth,
        depth_mean=mean.view(height, width),
        opacity=opacity.view(height, width).clamp(0.0, 1.0),
        normals=normals_from_depth(depth, Rays(*(part.to(depth) for part in rays))),
    )


def _render_chunks(
    field: Field, rays: Rays, chunk: int, config: ZipNerfConfig | None = None
) -> Iterator[tuple[RayRender, float]]:
    """The rays on the field's device, `chunk` at a time, with the share of them that is done then."""
    device = field.colour.rgb.weight.device
    count = len(rays.origins)
    for first in range(0, count, chunk):
        piece = Rays(*(part[first : first + chunk].to(device, torch.float32) for part in rays))
        yield render_rays(field, piece, config=config), min(1.0, (first + chunk) / count)


@torch.no_grad()
def render_uncertainty(field: Field, cameras: Cameras, view_index: int, chunk: int = 4096) -> Tensor:
    """(H, W) in [0, 1]: entropy of where each ray of the camera ends (see `ray_entropy`)."""
    width, height = (int(side) for side in cameras.size[view_index])
    rays = image_rays(cameras, view_index)
    parts = [ray_entropy(out.rounds[-1].weights) for out, _ in _render_chunks(field, rays, chunk)]
    return torch.cat(parts).view(height, width)


def render_ladder(
    field: Field,
    cameras: Cameras,
    view_index: int,
    config: ZipNerfConfig | None = None,
    scales: Sequence[float] = (1 / 8, 1 / 4, 1 / 2, 1),
    on_progress: Callable[[float], None] | None = None,
) -> Iterator[Render]:
    """The view at rising resolution, each as soon as it is done, for interactive use: stop iterating, or raise in
    `on_progress` (share of the present rung, see `render_image`), once the camera has moved on."""
    for scale in scales:
        yield render_image(field, cameras, view_index, config, scale, on_progress=on_progress)
