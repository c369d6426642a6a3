"""Hypothesis strategies and builders for cameras, shared by the geometry tests."""

from __future__ import annotations

import torch
from hypothesis import strategies as st
from torch import Tensor

from cat3d_core.cameras import Cameras
from cat3d_core.normalization import Similarity

seeds = st.integers(0, 2**32 - 1)


def random_rotation(generator: torch.Generator) -> Tensor:
    """(3, 3) uniformly random rotation, float64."""
    q, r = torch.linalg.qr(torch.randn(3, 3, generator=generator, dtype=torch.float64))
    q = q * torch.sign(torch.diagonal(r))
    return q if torch.linalg.det(q) > 0 else q * torch.tensor([-1.0, 1, 1], dtype=torch.float64)


def look_at(centers: Tensor, target: Tensor, up: Tensor | None = None) -> Tensor:
    """(N, 4, 4) OpenCV poses at `centers` (N, 3) looking at `target` (3,) with image-up nearest to `up`."""
    up = torch.tensor([0.0, 0, 1], dtype=torch.float64) if up is None else up
    forward = torch.nn.functional.normalize(target - centers, dim=-1)
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, up.expand_as(forward)), dim=-1)
    pose = torch.eye(4, dtype=torch.float64).repeat(len(centers), 1, 1)
    pose[:, :3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward], -1)
    pose[:, :3, 3] = centers
    return pose


def intrinsics(count: int, width: int, height: int, focal: float) -> Tensor:
    k = torch.tensor([[focal, 0, width / 2], [0, focal * 1.02, height / 2 + 1], [0, 0, 1]], dtype=torch.float64)
    return k.repeat(count, 1, 1)


def orbit(count: int, radius: float = 3.0, width: int = 64, height: int = 48, seed: int = 0) -> Cameras:
    """Cameras around the origin, slightly jittered, all looking near it."""
    g = torch.Generator().manual_seed(seed)
    angle = torch.arange(count, dtype=torch.float64) / max(count, 1) * 5.0
    centers = radius * torch.stack([angle.cos(), angle.sin(), torch.full_like(angle, 0.4)], -1)
    centers = centers + 0.05 * torch.randn(count, 3, generator=g, dtype=torch.float64)
    pose = look_at(centers, torch.zeros(3, dtype=torch.float64))
    return Cameras(intrinsics(count, width, height, 60.0), pose, torch.tensor([[width, height]]).repeat(count, 1))


def random_similarity(seed: int, scaled: bool = True) -> Similarity:
    g = torch.Generator().manual_seed(seed)
    scale = float(torch.exp(2 * torch.randn(1, generator=g, dtype=torch.float64))) if scaled else 1.0
    return Similarity(scale, random_rotation(g), 10 * torch.randn(3, generator=g, dtype=torch.float64))
