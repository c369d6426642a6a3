"""From densities to weights, depths and normals; the hash grid's query."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import torch
from torch import Tensor

from cat3d_core.rays import Rays
from cat3d_core.reconstruction.render import normals_from_depth
from cat3d_core.stress.draw import Draw
from cat3d_core.stress.routine import ROUNDING, SINGLE, Call, Exact, Reference, Routine, each, zero
from cat3d_core.zipnerf.field import encode_directions
from cat3d_core.zipnerf.gradients import safe_exp
from cat3d_core.zipnerf.grid_layout import PRIMES, GridLayout, make_layout
from cat3d_core.zipnerf.grid_reference import level_weights, query_reference
from cat3d_core.zipnerf.hash_grid import query
from cat3d_core.zipnerf.layers import Layer, chain
from cat3d_core.zipnerf.render import Round, expected_depth, weights_from_density

_BINS = 10
Query = Callable[[Tensor, Tensor, Tensor, GridLayout], Tensor]
_LAYOUT = make_layout(16, 256, 10, 2)  # a level of 16^3 and one of 32^3 do not fit 2^10 rows: all levels are hashed
_DENSE = make_layout(16, 32, 15, 2)  # both levels fit: zero outside the cube


def _density_inputs(draw: Draw) -> tuple[Tensor, ...]:
    """Fog, surfaces, e^40 and nothing, along rays from 0 to anywhere between 1e-6 and 1e6."""
    density = draw.magnitude(_BINS, 1e-12, 2e17)
    fog = draw.magnitude(_BINS, 1e-12, 1e-3)
    density = torch.where(draw.unit(1) < 0.3, fog, density)
    t = draw.edges(_BINS + 1) * draw.log_between(1, 1e-6, 1e6)
    return density, t, draw.direction()[:, 0] * draw.log_between(1, 1.0, 4.0)


def _before(depth: Tensor) -> Tensor:
    return torch.cat([torch.zeros_like(depth[:, :1]), depth[:, :-1].cumsum(-1)], -1)


def _weights_reference(density: Tensor, t: Tensor, direction: Tensor) -> Exact:
    """Transmittance as the running product of what each interval lets through; alpha by 2 exp(-x/2) sinh(x/2)."""
    depth = density * t.diff(dim=-1) * direction.square().sum(-1, keepdim=True).sqrt()
    half = depth.clamp(max=60.0) / 2
    alpha = torch.where(depth < 60.0, 2 * torch.exp(-half) * torch.sinh(half), 1.0)
    before = _before(depth)
    through = [torch.ones_like(depth[:, 0])]
    for i in range(depth.shape[1] - 1):
        through.append(through[-1] * torch.exp(-depth[:, i]))
    value = alpha * torch.stack(through, -1)
    # exp(-x) of a rounded x is off by x eps; where it is under 1e-30 it is nothing.
    return Exact(value, value.detach() * (1 + before.detach().clamp(max=200.0)) + 1e-30)


def _weights_gradient_scale(density: Tensor, t: Tensor, direction: Tensor) -> tuple[Tensor]:
    """The largest possible slope: each density's own optical width times what light reaches it."""
    width = t.diff(dim=-1) * direction.norm(dim=-1, keepdim=True)
    depth = density * width
    reached = torch.exp(-_before(depth))
    return ((width * reached * (1 + depth.cumsum(-1).clamp(max=200.0))).amax(-1) + 1e-30,)


def _exp_reference(x: Tensor) -> Tensor:
    """exp(min(x, 40)); beyond the cap the slope stays that at the cap (x - x is 0, its slope 1)."""
    capped = torch.exp(x.clamp(max=40.0))
    return capped + torch.where(x > 40.0, (x - x.detach()) * torch.exp(torch.tensor(40.0, dtype=torch.float64)), 0.0)


def _depth_inputs(draw: Draw) -> tuple[Tensor, ...]:
    t = draw.edges(_BINS + 1) * draw.log_between(1, 1e-6, 1e12)
    weights = draw.magnitude(_BINS, 1e-12, 0.1)
    return t, torch.where(draw.unit(1) < 0.1, 0.0, weights)


def _expected(t: Tensor, w: Tensor) -> Tensor:
    return expected_depth(Round(t, t, w))


def _expected_reference(t: Tensor, w: Tensor) -> Tensor:
    total = w.sum(-1)
    middle = (t[:, 1:] + t[:, :-1]) / 2
    mean = (middle * (w / torch.where(total > 0, total, 1.0)[:, None])).sum(-1)
    return torch.where(total > 0, mean, t[:, -1])


_SIDE = 4


def _plane_inputs(draw: Draw) -> tuple[Tensor, ...]:
    """A plane before a camera at the origin: depth, focal length in image widths, two slopes (dz/dx, dz/dy)."""
    focal = draw.log_between(1, 0.3, 10.0)
    slopes = draw.between(2, -0.5, 0.5) * draw.log_between(1, 1e-3, 1.0)
    return draw.log_between(1, 1e-6, 1e12), focal, slopes * focal.clamp(max=1.0)  # all of it in front of the camera


def _normals(depth: Tensor, focal: Tensor, slopes: Tensor) -> Tensor:
    """Angle between the estimated and the true normal, in units of the rounding of neighbouring points."""
    x = (torch.arange(_SIDE, dtype=depth.dtype) + 0.5) / _SIDE - 0.5
    directions = torch.stack([(x / focal).expand(_SIDE, _SIDE), (x[:, None] / focal).expand(_SIDE, _SIDE),
                              torch.ones(_SIDE, _SIDE, dtype=depth.dtype)], -1)  # fmt: skip
    # z = d + a X + b Y on the ray (x, y, 1): z = d / (1 - a x - b y)
    z = depth / (1 - directions[..., 0] * slopes[0] - directions[..., 1] * slopes[1])
    flat = directions.reshape(-1, 3)
    rays = Rays(torch.zeros_like(flat), flat, torch.ones_like(flat[:, :1]))
    got = normals_from_depth(z, rays).double()
    wide = slopes.double()
    true = torch.stack([wide[0], wide[1], -torch.ones(())])
    true = true / true.norm()
    neighbours = _SIDE * float(focal) * (1 + wide.norm() * float(focal))
    return ((got - true).norm(dim=-1).amax() / neighbours).to(depth.dtype)


def _grid_inputs(draw: Draw) -> tuple[Tensor, ...]:
    """Three samples of an interval: inside the cube, on cell borders, on its faces; sizes from nothing to the scene."""
    positions = draw.unit(9).view(-1, 3, 3)
    border = (positions * 32).round() / 32
    kind = draw.unit(9).view(-1, 3, 3)
    positions = torch.where(kind < 0.1, border, torch.where(kind > 0.97, 0.5 + positions.sign() / 2, positions))
    return positions, draw.magnitude(3)


def _table(layout: GridLayout, dtype: torch.dtype) -> Tensor:
    generator = torch.Generator().manual_seed(0)
    return torch.rand(layout.rows, layout.features, generator=generator, dtype=torch.float64).sub(0.5).to(dtype)


def _query(layout: GridLayout, function: Query) -> Call:
    def call(positions: Tensor, std: Tensor) -> Tensor:
        return function(_table(layout, positions.dtype), positions, std, layout).flatten(1)

    return call


def _query_exact(layout: GridLayout) -> Reference:
    """Eight corners by hand, the erf weight from erf, hashing in whole numbers."""

    def exact(positions: Tensor, std: Tensor) -> Exact:
        table = _table(layout, torch.float32).double()
        rows = []
        for level, n in enumerate(layout.resolutions):
            first, count = layout.offsets[level], layout.offsets[level + 1] - layout.offsets[level]
            weight = torch.erf(1 / (8**0.5 * n * std).clamp_min(1e-12))
            x = positions * n - 0.5
            low = torch.floor(x)
            total = torch.zeros(*std.shape, layout.features, dtype=torch.float64)
            for corner in itertools.product((0.0, 1.0), repeat=3):
                place = low + torch.tensor(corner, dtype=torch.float64)
                share = (1 - (x - place).abs()).prod(-1)
                cell = place.long()
                if n**3 > count:
                    products = [(cell[..., i] * PRIMES[i]) % (1 << 32) for i in range(3)]
                    row = (products[0] ^ products[1] ^ products[2]) % count
                else:
                    share = torch.where(((cell >= 0) & (cell < n)).all(-1), share, 0.0)
                    held = cell.clamp(0, n - 1)
                    row = held[..., 0] + n * (held[..., 1] + n * held[..., 2])
                total = total + (weight * share)[..., None] * table[first + row]
            rows.append(torch.cat([total.mean(1), weight.mean(1, keepdim=True)], -1))
        value = torch.stack(rows, 1).flatten(1)
        scale = torch.stack([row[:, -1:].expand(-1, row.shape[1]) for row in rows], 1).flatten(1)
        return Exact(value, scale)

    return exact


def _table_gradient(positions: Tensor, std: Tensor) -> Tensor:
    """Largest difference between the kernel's gradient of the table and the reference's, over the largest entry."""
    out = []
    for function in (query, query_reference):
        wide = function is query_reference
        table = _table(_LAYOUT, torch.float64 if wide else positions.dtype).requires_grad_()
        features = function(table, positions.to(table.dtype)[None], std.to(table.dtype)[None], _LAYOUT)[..., :-1]
        weight = torch.cos(torch.arange(features.numel(), dtype=torch.float64)).view(features.shape)
        with torch.enable_grad():
            (gradient,) = torch.autograd.grad((features * weight.to(features.dtype)).sum(), table)
        out.append(gradient.double())
    return ((out[0] - out[1]).abs().amax() / out[1].abs().amax().clamp_min(1e-30)).to(positions.dtype)


def _gradient_call(positions: Tensor, std: Tensor) -> Tensor:
    with torch.enable_grad():
        return each(_table_gradient)(positions, std)


_WIDTHS, _GROUP = (5, 20, 3, 17), 2


def _row_inputs(draw: Draw) -> tuple[Tensor, ...]:
    return (draw.normal(_GROUP * _WIDTHS[0]).view(-1, _GROUP, _WIDTHS[0]) * draw.log_between(1, 1e-6, 1e6)[..., None],)


def _layers(count: int, dtype: torch.dtype) -> list[Layer]:
    """The first adds the same to all rows, the second something to each case, the third nothing at all."""
    draw = torch.Generator().manual_seed(0)
    weights = [torch.randn(b, a, generator=draw).to(dtype) for a, b in itertools.pairwise(_WIDTHS)]
    shared, zeros = torch.randn(1, _WIDTHS[1], generator=draw), torch.zeros(1, _WIDTHS[3])
    own = torch.cos(torch.arange(_WIDTHS[2]) + torch.arange(count)[:, None] % 7)
    added = [each.to(dtype) for each in (shared, own, zeros)]
    return [Layer(*each) for each in zip(weights, added, (True, False, True), strict=True)]


def _chain(rows: Tensor) -> Tensor:
    if not len(rows):
        return rows.new_zeros(0, _GROUP, _WIDTHS[3])
    [out] = chain(rows.flatten(0, 1), _layers(len(rows), rows.dtype), (False, False, True))
    return out.view(-1, _GROUP, _WIDTHS[3])


def _chain_steps(rows: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The answer in float64, the size of the sums that it is made of, and whether a case has one near a bend."""
    x, size, bent = rows, rows.detach().abs(), torch.zeros(len(rows), dtype=torch.bool)
    for weight, added, relu in _layers(len(rows), torch.float64):
        own = added.expand(len(rows), -1)[:, None]
        x = (x[..., None, :] * weight).sum(-1) + own
        size = (size[..., None, :] * weight.abs()).sum(-1) + own.abs()
        bent |= (relu & (x.detach().abs() < 1e-5 * size)).flatten(1).any(1)
        x = x.clamp(min=0) if relu else x
    return x, size, bent


def _chain_reference(rows: Tensor) -> Exact:
    return Exact(*_chain_steps(rows)[:2])


def _chain_slope(rows: Tensor) -> tuple[Tensor]:
    """The products of all weights. Near a bend, within rounding, either slope is right: such cases say nothing."""
    slope = torch.ones(1, 1, dtype=torch.float64)
    for weight, _, _ in _layers(len(rows), torch.float64):
        slope = weight.abs() @ slope.expand(weight.shape[1], -1)
    return (torch.where(_chain_steps(rows)[2], torch.inf, float(slope.sum())),)


def _encode_reference(d: Tensor) -> Exact:
    parts = [d] + [(2**k * d).sin() for k in range(4)] + [torch.sin(2**k * d + torch.pi / 2) for k in range(4)]
    value = torch.cat(parts, -1)
    return Exact(value, torch.ones_like(value))


ROUTINES = [
    Routine(
        "render.weights_from_density", "fog of 1e-12 to walls of e^40, value and slope; in float32 the kernel",
        _density_inputs, weights_from_density, _weights_reference, ROUNDING,
        ROUNDING, gradient_scale=_weights_gradient_scale,
    ),
    Routine(
        "layers.chain", "three narrow layers, rows of 1e-6 to 1e6, value and slope; in float32 the kernel",
        _row_inputs, _chain, _chain_reference, ROUNDING, ROUNDING, gradient_scale=_chain_slope,
    ),
    Routine(
        "field.safe_exp", "exp with value and slope capped at e^40", lambda draw: (draw.between(1, -200, 200)[:, 0],),
        safe_exp, _exp_reference, ROUNDING, ROUNDING, floor=1e-30,
    ),
    Routine(
        "field.encode_directions", "sines and cosines of unit directions", lambda draw: (draw.direction()[:, 0],),
        lambda d: encode_directions(d, 4), _encode_reference, ROUNDING,
    ),
    Routine(
        "render.expected_depth", "mean depth up to 1e12; rays without weight give the far end",
        _depth_inputs, _expected, _expected_reference, ROUNDING,
    ),
    Routine(
        "render.normals_from_depth", "normals of a plane at depths from 1e-6 to 1e12",
        _plane_inputs, each(_normals), zero, ROUNDING, share=0.05,
    ),
    Routine(
        "hash_grid.level_weights", "erf weight for any size, zero included", lambda draw: (draw.magnitude(1)[:, 0],),
        lambda std: level_weights(std, 512),
        lambda std: torch.erf(1 / (8**0.5 * 512 * std).clamp_min(1e-12)), ROUNDING,
    ),
    Routine(
        "hash_grid.query_reference[hashed]", "mean over samples, borders and any size included",
        _grid_inputs, _query(_LAYOUT, query_reference), _query_exact(_LAYOUT), {SINGLE: 2e-6}, share=0.3,
    ),
    Routine(
        "hash_grid.query_reference[dense]", "zero outside the cube",
        _grid_inputs, _query(_DENSE, query_reference), _query_exact(_DENSE), {SINGLE: 2e-6}, share=0.3,
    ),
    Routine(
        "hash_grid.query[hashed]", "the kernel of this machine, the same numbers",
        _grid_inputs, _query(_LAYOUT, query), _query_exact(_LAYOUT), {SINGLE: 1e-5}, share=0.3,
    ),
    Routine(
        "hash_grid.query[dense]", "the kernel of this machine, zero outside the cube",
        _grid_inputs, _query(_DENSE, query), _query_exact(_DENSE), {SINGLE: 1e-5}, share=0.3,
    ),
    Routine(
        "hash_grid.query[gradient]", "the kernel's gradient of the table", _grid_inputs, _gradient_call, zero,
        {SINGLE: 4e-6}, share=0.02,
    ),
]  # fmt: skip
