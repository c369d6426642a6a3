"""The hash grid's query in plain torch, the reference of the kernels.

Samples of an interval -> corners of their cells -> weight of the level -> mean.
Positions are in the unit cube, standard deviations in its units.
"""

from __future__ import annotations

import itertools

import torch
from torch import Tensor

from cat3d_core.zipnerf.grid_layout import PRIMES, GridLayout


def level_weights(std: Tensor, resolution: int) -> Tensor:
    """Down-weighting of a level of the given resolution for samples of this std: erf(1 / (sqrt 8 std n)) (Zip-NeRF eq.
    5).

    The clamp keeps std = 0 finite (weight 1); no gradient flows to std in training, and here it would be finite too.
    """
    return torch.erf(1.0 / (8.0**0.5 * std * resolution).clamp_min(1e-12))


def _corner(layout: GridLayout, level: int, cell: Tensor, bits: tuple[int, ...]) -> tuple[Tensor, Tensor | None]:
    """Table row (...) of a corner of cells (..., 3) int64, and its validity for dense levels."""
    n = layout.resolutions[level]
    start, rows = layout.offsets[level], layout.offsets[level + 1] - layout.offsets[level]
    x, y, z = (cell[..., axis] + bits[axis] for axis in range(3))
    if layout.hashed(level):
        mask32 = 0xFFFFFFFF
        row = (x & mask32) ^ (y * PRIMES[1] & mask32) ^ (z * PRIMES[2] & mask32)
        return start + (row & (rows - 1)), None
    inside = (x >= 0) & (x < n) & (y >= 0) & (y < n) & (z >= 0) & (z < n)
    return start + torch.where(inside, x + n * (y + n * z), 0), inside


def query_reference(table: Tensor, positions: Tensor, std: Tensor, layout: GridLayout) -> Tensor:
    """The query in plain torch, differentiable in the table by autograd.

    table (rows, F), positions (N, S, 3), std (N, S) -> (N, L, F + 1), for each level F features, the mean over the S
    samples of weight times trilinear interpolation between cell centres, and last the mean weight.
    """
    levels = []
    for level, n in enumerate(layout.resolutions):
        weight = level_weights(std, n)
        scaled = positions * n - 0.5
        cell = scaled.floor()
        fraction = scaled - cell
        cell = cell.long()
        value = torch.zeros((*std.shape, layout.features), dtype=table.dtype, device=table.device)
        for bits in itertools.product((0, 1), repeat=3):
            row, inside = _corner(layout, level, cell, bits)
            share = weight
            for axis in range(3):
                share = share * (fraction[..., axis] if bits[axis] else 1.0 - fraction[..., axis])
            if inside is not None:
                share = torch.where(inside, share, 0.0)
            value = value + share[..., None] * table[row]
        levels.append(torch.cat([value.mean(1), weight.mean(1)[:, None]], 1))
    return torch.stack(levels, 1)
