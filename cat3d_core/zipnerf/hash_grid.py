"""Multi-resolution hash grid with the fused Zip-NeRF query: samples of an interval -> corners -> erf weight -> mean.

This file holds the layout of the table, the plain torch reference and the choice of backend; `hash_grid_cpu` and
`hash_grid_triton` compute the same in one pass. Positions are in the unit cube, standard deviations in its units.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import torch
from torch import Tensor

# Spatial hash of instant-ngp: (x * 1) xor (y * p1) xor (z * p2) in 32-bit arithmetic, modulo the table size.
PRIMES = (1, 2654435761, 805459861)


@dataclass(frozen=True)
class GridLayout:
    """Levels of one grid, their resolutions doubling; level l owns rows offsets[l]:offsets[l+1] of the table.

    A level whose resolution^3 fits the table is dense (x fastest) and zero outside the cube, others are hashed.
    """

    resolutions: tuple[int, ...]
    offsets: tuple[int, ...]
    features: int

    @property
    def levels(self) -> int:
        return len(self.resolutions)

    @property
    def rows(self) -> int:
        return self.offsets[-1]

    def hashed(self, level: int) -> bool:
        return self.resolutions[level] ** 3 > self.offsets[level + 1] - self.offsets[level]


def make_layout(base_resolution: int, max_resolution: int, log2_table: int, features: int) -> GridLayout:
    """Layout with resolutions base, 2 base, ... max. Raises ValueError where max is not base times a power of two."""
    count = max_resolution // base_resolution
    if base_resolution * count != max_resolution or count < 1 or count & (count - 1):
        raise ValueError(f"Grid resolution {max_resolution} is not {base_resolution} times a power of two.")
    if not 4 <= log2_table <= 28:
        raise ValueError(f"A level's table has 2^4 to 2^28 rows, got 2^{log2_table}.")
    resolutions = tuple(base_resolution << level for level in range(count.bit_length()))
    rows = [min(n**3, 1 << log2_table) for n in resolutions]
    return GridLayout(resolutions, tuple(itertools.accumulate(rows, initial=0)), features)


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


def query_reference(table: Tensor, positions: Tensor, std: Tensor, layout: GridLayout) -> tuple[Tensor, Tensor]:
    """The query in plain torch, differentiable in the table by autograd.

    table (rows, F), positions (N, S, 3), std (N, S) -> features (N, L, F): mean over the S samples of weight times
    trilinear interpolation between cell centres; weights (N, L): mean weight of each level.
    """
    features, weights = [], []
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
        features.append(value.mean(1))
        weights.append(weight.mean(1))
    return torch.stack(features, 1), torch.stack(weights, 1)


def query(table: Tensor, positions: Tensor, std: Tensor, layout: GridLayout) -> tuple[Tensor, Tensor]:
    """`query_reference` by the fastest kernel there is for the tensors' device and dtype; gradient for the table only.

    float32 on the CPU: the C++ kernel where a compiler is found; float32 on CUDA: Triton where it is installed.
    Otherwise the reference. All CPU paths are deterministic.
    """
    if table.dtype == torch.float32:
        if table.device.type == "cpu":
            from cat3d_core.zipnerf import hash_grid_cpu

            if hash_grid_cpu.available():
                return hash_grid_cpu.query(table, positions, std, layout)
        elif table.device.type == "cuda":
            from cat3d_core.zipnerf import hash_grid_triton

            if hash_grid_triton.available():
                return hash_grid_triton.query(table, positions, std, layout)
    return query_reference(table, positions, std, layout)
