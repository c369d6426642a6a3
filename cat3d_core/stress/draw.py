"""Inputs of the stress search as a function of points in the unit cube.

A routine's inputs are a fixed map from uniform numbers to its arguments, so that the search can be generic: random
points first, then small and large moves of the worst ones, always inside what the routine claims to handle.
"""

from __future__ import annotations

import torch
from torch import Tensor

from cat3d_core.quaternions import rotation_matrices

# Shares of special values among drawn magnitudes.
_ZEROS, _DENORMALS, _ONES = 0.04, 0.03, 0.05


class Draw:
    """Random numbers of `count` cases, (count, n) at a time. `columns` afterwards holds all of them, (count, total);
    given such columns, the same inputs come out again. `smallest` is the dtype's smallest normal number."""

    def __init__(
        self, count: int, generator: torch.Generator, smallest: float = 0.0, columns: Tensor | None = None
    ) -> None:
        self.count, self.smallest = count, smallest
        self._generator, self._given, self._position = generator, columns, 0
        self._drawn: list[Tensor] = []

    @property
    def columns(self) -> Tensor:
        return torch.cat(self._drawn, 1) if self._drawn else torch.zeros(self.count, 0, dtype=torch.float64)

    def unit(self, n: int) -> Tensor:
        """(count, n) uniform in [0, 1)."""
        if self._given is None:
            out = torch.rand(self.count, n, generator=self._generator, dtype=torch.float64)
        else:
            out = self._given[:, self._position : self._position + n]
        self._position += n
        self._drawn.append(out)
        return out

    def between(self, n: int, low: float, high: float) -> Tensor:
        """(count, n) uniform in [low, high)."""
        return low + (high - low) * self.unit(n)

    def log_between(self, n: int, low: float, high: float) -> Tensor:
        """(count, n) log-uniform in [low, high)."""
        return low * (high / low) ** self.unit(n)

    def magnitude(self, n: int, low: float = 1e-12, high: float = 1e12, special: bool = True) -> Tensor:
        """(count, n) >= 0, log-uniform; with `special` also zeros, exact ones and denormal numbers."""
        value = self.log_between(n, low, high)
        if not special:
            return value
        kind = self.unit(n)
        value = torch.where(kind < _ZEROS, 0.0, value)
        denormal = (kind >= _ZEROS) & (kind < _ZEROS + _DENORMALS)
        # Denormal numbers lie below the smallest normal one; the fraction reuses the kind's own digits.
        value = torch.where(denormal, self.smallest * (kind - _ZEROS) / _DENORMALS, value)
        return torch.where((kind > 1 - _ONES) & (low <= 1.0 <= high), 1.0, value)

    def signed(self, n: int, low: float = 1e-12, high: float = 1e12, special: bool = True) -> Tensor:
        """(count, n) of either sign, magnitudes as in `magnitude`."""
        return self.magnitude(n, low, high, special) * torch.where(self.unit(n) < 0.5, -1.0, 1.0)

    def normal(self, n: int) -> Tensor:
        """(count, n) standard normal, cut at 8 sigma."""
        return (2 * self.unit(n) - 1).clamp(-1 + 1e-15, 1 - 1e-15).erfinv() * 2**0.5

    def direction(self, n: int = 1) -> Tensor:
        """(count, n, 3) unit vectors, uniform on the sphere; a few along the axes."""
        height = self.between(n, -1, 1)
        turn = 2 * torch.pi * self.unit(n)
        beside = (1 - height.square()).clamp_min(0).sqrt()
        vector = torch.stack([beside * turn.cos(), beside * turn.sin(), height], -1)
        axis = torch.eye(3, dtype=torch.float64)[(self.unit(n) * 3).long()]
        kind = self.unit(n)[..., None]
        return torch.where(kind < 0.03, axis, torch.where(kind > 0.97, -axis, vector))

    def rotation(self, n: int = 1) -> Tensor:
        """(count, n, 3, 3) rotations, from uniform unit quaternions; a few are the identity or half turns."""
        q = self.normal(4 * n).view(self.count, n, 4)
        kind = self.unit(n)
        first = torch.eye(4, dtype=torch.float64)
        q = torch.where((kind < 0.03)[..., None], first[0], torch.where((kind > 0.97)[..., None], first[2], q))
        return rotation_matrices(q)

    def edges(self, n: int, low: float = 0.0, high: float = 1.0, ties: bool = True) -> Tensor:
        """(count, n) sorted numbers from low to high, both included; some equal, some very close together."""
        power = torch.where(self.unit(1) < 0.5, 1.0, 8.0)  # half of the rows crowd towards low
        inner = self.unit(n - 2) ** power
        inner = torch.where(inner < 1e-25, 0.0, inner)  # bins of denormal width count as having none
        if ties:
            kind, first = self.unit(n - 2), inner[:, :1]
            near = first * (1 - 10 ** (-8 + 6 * self.unit(n - 2)))
            inner = torch.where(kind < 0.1, first, torch.where(kind < 0.2, near, inner))
            inner = torch.where(kind > 0.97, 1.0, torch.where(kind > 0.94, 0.0, inner))
        rows = torch.cat([torch.zeros(self.count, 1), inner, torch.ones(self.count, 1)], 1).sort(1).values
        return low + (high - low) * rows

    def choice(self, *values: float) -> Tensor:
        """(count, 1) one of the values."""
        table = torch.tensor(values, dtype=torch.float64)
        return table[(self.unit(1) * len(values)).long()]
