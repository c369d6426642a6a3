"""Where the planes of a sweep stand, and distributions over them."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

# A photo's planes lie evenly in t, with inverse depth = SCALE * (exp(rate * t) - 1): nearly evenly in inverse depth
# about the unit distance, where most surfaces of a normalised scene are, and evenly in its logarithm close by.
SCALE = 0.9


def inverse_depth_of(t: Tensor, nearest: float) -> Tensor:
    """Inverse depth at t: 0 at t = 0, `nearest` at t = 1."""
    return SCALE * torch.expm1(t * math.log1p(nearest / SCALE))


def position_of(inverse_depth: Tensor, nearest: float) -> Tensor:
    """The t of an inverse depth >= 0, the inverse of `inverse_depth_of`; not clamped to 1."""
    return torch.log1p(inverse_depth.clamp(min=0) / SCALE) / math.log1p(nearest / SCALE)


def soft_assignment(position: Tensor, planes: int) -> Tensor:
    """(N, H, W) positions in [0, 1] -> (N, planes, H, W): linear weights of the two neighbouring planes."""
    index = torch.arange(planes, device=position.device, dtype=position.dtype).view(1, planes, 1, 1)
    return (1 - (position.clamp(0, 1)[:, None] * (planes - 1) - index).abs()).clamp(min=0)


def local_mean(probability: Tensor, reach: int = 2) -> Tensor:
    """(N, D, h, w) -> (N, 1, h, w): mean position in [0, 1] over the planes within `reach` of the most probable one, so
    that two surfaces are not averaged into a third."""
    planes = probability.shape[1]
    index = torch.arange(planes, device=probability.device).view(1, planes, 1, 1)
    near = (index - probability.argmax(1, keepdim=True)).abs() <= reach
    weight = probability * near
    return (weight * index).sum(1, keepdim=True) / weight.sum(1, keepdim=True).clamp(min=1e-6) / (planes - 1)


def quantiles(probability: Tensor, count: int, floor: float = 0.07) -> tuple[Tensor, Tensor]:
    """Positions of equally probable hypotheses.

    probability (N, D, h, w) over planes at positions 0 .. 1 -> positions (N, count, h, w), ascending, the middles of
    `count` equal shares, and the density there. `floor` of the distribution is spread evenly, so that a wrong but
    certain one still leaves a few hypotheses elsewhere.
    """
    n, planes, h, w = probability.shape
    mixed = (1 - floor) * probability + floor / planes
    mixed = (mixed / mixed.sum(1, keepdim=True)).permute(0, 2, 3, 1)
    edges = F.pad(mixed.cumsum(-1), (1, 0)).contiguous()
    middles = ((torch.arange(count, device=edges.device) + 0.5) / count).expand(n, h, w, count).contiguous()
    cell = torch.searchsorted(edges, middles).clamp(1, planes)
    low, high = edges.gather(-1, cell - 1), edges.gather(-1, cell)
    place = cell - 1 + (middles - low) / (high - low).clamp(min=1e-6) - 0.5
    density = mixed.gather(-1, cell - 1)
    return (place / (planes - 1)).clamp(0, 1).permute(0, 3, 1, 2), density.permute(0, 3, 1, 2)
