"""Intervals along rays: histograms, their sampling, and the Gaussians that stand for cones."""

from __future__ import annotations

import torch
from torch import Tensor

from cat3d_core.rays import Rays, perpendicular_basis
from cat3d_core.stress.draw import Draw
from cat3d_core.stress.routine import DOUBLE, ROUNDING, SINGLE, Exact, Routine, zero
from cat3d_core.zipnerf import ray_intervals, stepfun
from cat3d_core.zipnerf.frustums import (
    cone_samples,
    grid_samples,
    grid_samples_reference,
    sample_distances,
)

_BINS = 12


def _histogram(draw: Draw) -> tuple[Tensor, Tensor]:
    """Edges in [0, 1] with ties, and weights of any magnitude with zeros; some rows without any weight."""
    weights = draw.magnitude(_BINS, 1e-12, 1.0)
    peak = torch.nn.functional.one_hot((draw.unit(1)[:, 0] * _BINS).long(), _BINS)
    kind = draw.unit(1)
    weights = torch.where(kind < 0.1, 0.0, torch.where(kind < 0.3, peak.double(), weights))
    return draw.edges(_BINS + 1), weights / weights.sum(-1, keepdim=True).clamp_min(1.0)


def _pdf_reference(t: Tensor, w: Tensor) -> Tensor:
    width = t.diff(dim=-1)
    return torch.where(width > 0, w / torch.where(width > 0, width, 1.0), 0.0)


def _cdf_residual(x: Tensor, u: Tensor, t: Tensor, w: Tensor) -> Tensor:
    """How far u lies outside the values that the cumulative distribution takes within rounding of x, (rows, m)."""
    eps = torch.finfo(x.dtype).eps
    x64, u64, t64, w64 = x.double(), u.double(), t.double(), w.double()
    total = w64.sum(-1, keepdim=True)

    def cdf(y: Tensor, side: str) -> Tensor:
        start, stop = t64[:, None, :-1], t64[:, None, 1:]
        width = stop - start
        inside = (y[..., None] - start) / torch.where(width > 0, width, 1.0)
        jump = (y[..., None] >= start).double() if side == "right" else (y[..., None] > start).double()
        share = torch.where(width > 0, inside.clamp(0, 1), jump)
        return (share * w64[:, None]).sum(-1) / total

    slack = 4 * eps * t64[:, -1:].abs()
    low, high = cdf(x64 - slack, "left"), cdf(x64 + slack, "right")
    return (low - u64).clamp_min(0) + (u64 - high).clamp_min(0)


def _invert_inputs(draw: Draw) -> tuple[Tensor, ...]:
    t, w = _histogram(draw)
    return t, w, draw.unit(7), draw.between(1, -300, 300)


def _invert(t: Tensor, w: Tensor, u: Tensor, shift: Tensor) -> Tensor:
    """Softmax does not change when all logits move together, but for what that rounds off them."""
    w = torch.where(t.diff(dim=-1) > 0, w, 0.0)
    w = torch.where(w.sum(-1, keepdim=True) > 0, w, t.diff(dim=-1))  # no weight at all: uniform
    u = u.clamp(max=1 - torch.finfo(u.dtype).eps)
    x = stepfun.invert_cdf(u, t, w.log() + shift)
    return torch.where(torch.isfinite(x), _cdf_residual(x, u, t, w).to(x.dtype) / (1 + shift.abs()), torch.inf)


def _intervals(t: Tensor, w: Tensor) -> Tensor:
    """By how much the new edges are out of order or out of [0, 1]."""
    logits = w.clamp_min(torch.finfo(w.dtype).tiny).log()
    edges = ray_intervals.sample_intervals(t, logits, 9)
    bad = (-edges.diff(dim=-1)).clamp_min(0).sum(-1) + (edges - 1).clamp_min(0).sum(-1) + (-edges).clamp_min(0).sum(-1)
    return torch.where(torch.isfinite(edges).all(-1), bad, torch.inf)


_HALFWIDTH = 0.01


def _blur_inputs(draw: Draw) -> tuple[Tensor, ...]:
    return (draw.edges(9), *_histogram(draw))


def _blur_reference(query: Tensor, t: Tensor, w: Tensor) -> Exact:
    """Average of the cumulative weight over a window, as a sum of positive trapezoids, one for each bin."""
    before = w.cumsum(-1) - w
    density = _pdf_reference(t, w)
    start, stop = t[:, None, :-1], t[:, None, 1:]

    def smooth(x: Tensor) -> Tensor:
        low = (x - _HALFWIDTH)[..., None].clamp(start, stop)
        high = (x + _HALFWIDTH)[..., None].clamp(start, stop)
        inside = (high - low) * (before[:, None] + density[:, None] * ((low + high) / 2 - start))
        beyond = (x + _HALFWIDTH - torch.maximum(t[:, -1:], x - _HALFWIDTH)).clamp_min(0) * w.sum(-1, keepdim=True)
        return (inside.sum(-1) + beyond) / (2 * _HALFWIDTH)

    mass = smooth(query).diff(dim=-1).clamp_min(0)
    return Exact(mass, w.sum(-1, keepdim=True).expand_as(mass))


def _far_histogram(draw: Draw) -> tuple[Tensor, ...]:
    t, w = _histogram(draw)
    return t * draw.log_between(1, 1e-6, 1e6), w


def _distortion_reference(t: Tensor, w: Tensor) -> Tensor:
    """The double sum; middles of bins i < j lie (t_j - t_i+1) + (width_i + width_j) / 2 apart."""
    width = t.diff(dim=-1)
    apart = (t[:, None, :-1] - t[:, 1:, None]) + (width[:, :, None] + width[:, None]) / 2
    pairs = (w[:, :, None] * w[:, None] * apart).triu(1)
    return 2 * pairs.sum((1, 2)) + (w * w * width).sum(-1) / 3


def _quantile(t: Tensor, w: Tensor) -> Tensor:
    x = stepfun.quantile(t, w, 0.5)
    empty = w.sum(-1) <= 0
    half = torch.full_like(x, 0.5)[:, None]
    off = _cdf_residual(x[:, None], half, t, torch.where(empty[:, None], 1.0, w))[:, 0].to(x.dtype)
    off = torch.where(empty, (x - t[:, -1]).abs(), off)
    return torch.where(torch.isfinite(x), off, torch.inf)


def _direction_inputs(draw: Draw) -> tuple[Tensor, ...]:
    tilt = draw.direction()[:, 0] * draw.log_between(1, 1e-12, 1e-2)
    pole = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64)
    kind = draw.unit(1)
    return (torch.where(kind < 0.3, pole + tilt, draw.direction()[:, 0]) * draw.log_between(1, 1e-9, 1e9),)


def _basis(d: Tensor) -> Tensor:
    """Largest entry by which the basis and the direction fail to be orthonormal."""
    wide = d.double()
    frame = torch.cat([(wide / wide.norm(dim=-1, keepdim=True))[:, None], perpendicular_basis(d).double()], 1)
    off = (frame @ frame.transpose(1, 2) - torch.eye(3, dtype=torch.float64)).abs().flatten(1)
    return off.amax(1).to(d.dtype) if len(d) else d[:, 0]


def _edge_inputs(draw: Draw) -> tuple[Tensor, ...]:
    near = draw.magnitude(1)
    return (near + draw.edges(_BINS + 1) * draw.magnitude(1),)


def _distances_reference(t: Tensor) -> Tensor:
    """Zip-NeRF eq. 2 as printed: t0 + td (t1^2 + 2 tm^2 + 3/sqrt(7) (2j/5 - 1) sqrt((td^2 - tm^2)^2 + 4 tm^4))
    / (td^2 + 3 tm^2), tm the middle and td half the width."""
    t0, t1 = t[:, :-1, None], t[:, 1:, None]
    tm, td = (t0 + t1) / 2, (t1 - t0) / 2
    steps = 3 / 7**0.5 * (2 * torch.arange(6, dtype=torch.float64) / 5 - 1)
    top = t1 * t1 + 2 * tm * tm + steps * ((td * td - tm * tm) ** 2 + 4 * tm**4).sqrt()
    return t0 + td * top / (td * td + 3 * tm * tm).clamp_min(1e-300)


def _cone_inputs(draw: Draw) -> tuple[Tensor, ...]:
    return draw.signed(3), draw.direction()[:, 0], draw.log_between(1, 1e-6, 0.1), *_edge_inputs(draw)


def _cone(origin: Tensor, direction: Tensor, radius: Tensor, t: Tensor) -> Tensor:
    """Per sample: distance along the ray, distance beside it, standard deviation."""
    means, std = cone_samples(origin, direction, radius, t)
    offset = means.double() - origin.double()[:, None, None]
    unit = direction.double() / direction.double().norm(dim=-1, keepdim=True)
    along = (offset * unit[:, None, None]).sum(-1)
    beside = (offset - along[..., None] * unit[:, None, None]).norm(dim=-1)
    return torch.stack([along, beside, std.double()], -1).sum(2).to(t.dtype)


def _cone_reference(origin: Tensor, direction: Tensor, radius: Tensor, t: Tensor) -> Exact:
    along = _distances_reference(t)
    length = direction.norm(dim=-1)[:, None, None]
    std = along * radius[..., None] / 8**0.5
    reach = origin.abs().amax(-1)[:, None, None] + along * (length + radius[..., None])
    value = torch.stack([along * length, 2 * std, std], -1).sum(2)
    return Exact(value, torch.stack([reach, reach, std], -1).sum(2))


def _grid(origin: Tensor, direction: Tensor, radius: Tensor, t: Tensor) -> Tensor:
    """Per sample: place in the grid's cube and standard deviation there."""
    positions, std = grid_samples(Rays(origin, direction, radius), t)
    return torch.cat([positions, std[..., None]], -1)


def _grid_reference(origin: Tensor, direction: Tensor, radius: Tensor, t: Tensor) -> Exact:
    """The torch version in float64; the scales are what rounding of origin + distance along the ray comes to."""
    rays = Rays(origin, direction, radius)
    positions, std = grid_samples_reference(rays, t)
    distance = cone_samples(*rays, t)[0].norm(dim=-1).clamp_min(1.0)
    along = _distances_reference(t).amax(-1, keepdim=True)
    reach = (
        origin.norm(dim=-1)[:, None, None] + along * (direction.norm(dim=-1) + radius[:, 0])[:, None, None]
    ) / distance
    scale = torch.cat([(0.5 + 0.25 * reach)[..., None].expand_as(positions), (std * (1 + reach))[..., None]], -1)
    return Exact(torch.cat([positions, std[..., None]], -1), scale)


ROUTINES = [
    Routine(
        "stepfun.pdf_from_weights", "0 where a bin has no width", _histogram, stepfun.pdf_from_weights, _pdf_reference,
        {DOUBLE: 4e-16, SINGLE: 2e-7}, {DOUBLE: 4e-16, SINGLE: 2e-7}, wrt=(1,),
    ),
    Routine(
        "stepfun.invert_cdf", "the distribution at the answer is u, within rounding of the answer",
        _invert_inputs, _invert, zero, ROUNDING,
    ),
    Routine(
        "stepfun.sample_intervals", "ordered and inside [0, 1], rays without weight too; in float32 the kernel",
        _histogram, _intervals, zero, {DOUBLE: 1e-15, SINGLE: 2e-7},
    ),
    Routine(
        "stepfun.blurred_resample", "weights of the blurred histogram, worked in float64",
        _blur_inputs, lambda q, t, w: stepfun.blurred_resample(q, t, w, _HALFWIDTH), _blur_reference,
        {DOUBLE: 2e-13, SINGLE: 2e-7},
    ),
    Routine(
        "stepfun.distortion", "value and gradient, never negative; in float32 the kernel",
        _far_histogram, ray_intervals.distortion,
        _distortion_reference, ROUNDING, ROUNDING, wrt=(1,),
    ),
    Routine(
        "stepfun.quantile", "half of the weight lies below; rays without weight give the far end",
        _far_histogram, _quantile, zero, ROUNDING,
    ),
    Routine(
        "rays.perpendicular_basis", "orthonormal for every direction", _direction_inputs, _basis, zero,
        ROUNDING,
    ),
    Routine(
        "frustums.sample_distances", "samples of intervals from 0 to 1e12", _edge_inputs, sample_distances,
        _distances_reference, ROUNDING, floor=1e-30,
    ),
    Routine(
        "frustums.cone_samples", "place and size of the Gaussians", _cone_inputs, _cone, _cone_reference,
        ROUNDING, floor=1e-30,
    ),
    Routine(
        "frustums.grid_samples", "the kernel of this machine, the same numbers", _cone_inputs, _grid, _grid_reference,
        ROUNDING, floor=1e-30,
    ),
]  # fmt: skip
