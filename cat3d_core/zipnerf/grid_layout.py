"""The table of a multi-resolution hash grid: which level owns which rows, and how a cell finds its row."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

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
