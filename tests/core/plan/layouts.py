"""Captured layouts of each family, and a check that a plan moved with the world."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from cat3d_core.cameras import Cameras
from cat3d_core.normalization import Similarity
from cat3d_core.plan import Plan
from tests.core.strategies import intrinsics, look_at

F64 = torch.float64


def cameras(centers: Tensor, targets: Tensor | None = None, width: int = 96, height: int = 64) -> Cameras:
    """Upright cameras at centers (N, 3) looking at the origin, or each at its own target."""
    targets = torch.zeros(len(centers), 3, dtype=F64) if targets is None else targets
    pose = torch.cat([look_at(c[None], t) for c, t in zip(centers, targets, strict=True)])
    return Cameras(intrinsics(len(centers), width, height, 80.0), pose, torch.tensor([[width, height]] * len(centers)))


def _circle(count: int, degrees: float, radius: float = 1.0, height: float = 0.4) -> Tensor:
    angle = torch.linspace(0, math.radians(degrees), count, dtype=F64)
    return torch.stack([radius * angle.cos(), radius * angle.sin(), torch.full_like(angle, height)], -1)


def _noise(count: int, amount: float, seed: int = 3) -> Tensor:
    return amount * torch.randn(count, 3, generator=torch.Generator().manual_seed(seed), dtype=F64)


def forward_facing(count: int = 9) -> Cameras:
    side = torch.arange(count, dtype=F64) % 3 - 1
    top = torch.div(torch.arange(count), 3, rounding_mode="floor").to(F64) - 1
    return cameras(torch.stack([0.12 * side, torch.full_like(side, -1.0), 0.08 * top], -1) + _noise(count, 0.004))


def ring(count: int = 9) -> Cameras:
    return cameras(_circle(count + 1, 360.0)[:count] + _noise(count, 0.02))


def arc(count: int = 5, degrees: float = 100.0) -> Cameras:
    return cameras(_circle(count, degrees) + _noise(count, 0.01))


def patch(count: int = 12) -> Cameras:
    g = torch.Generator().manual_seed(5)
    azimuth = 1.6 * torch.rand(count, generator=g, dtype=F64)
    elevation = 0.1 + 0.9 * torch.rand(count, generator=g, dtype=F64)
    c = torch.stack([azimuth.cos() * elevation.cos(), azimuth.sin() * elevation.cos(), elevation.sin()], -1)
    return cameras(c)


def walk(count: int = 8) -> Cameras:
    t = torch.linspace(0, 1, count, dtype=F64)
    centers = torch.stack([0.1 * (3 * t).sin(), 2 * t, 0 * t], -1)
    ahead = torch.stack([0.4 * (3 * t).cos(), torch.full_like(t, 1.0), -0.05 + 0 * t], -1)
    return cameras(centers, centers + 3 * ahead)


def single() -> Cameras:
    return cameras(torch.tensor([[0.2, -1.0, 0.3]], dtype=F64))


FAMILIES = {
    "llff": forward_facing,
    "mipnerf360": ring,
    "co3d": arc,
    "dtu": patch,
    "realestate10k": walk,
}


def assert_moved(plan: Plan, moved: Plan, g: Similarity, tolerance: float = 1e-6) -> None:
    """`moved` is g applied to `plan`: same groups and reasons, poses mapped (tolerance relative to the distance)."""
    expected = g.cameras(plan.cameras)
    error = (moved.cameras.centers - expected.centers).norm(dim=-1).max() / moved.frame.distance
    assert error < tolerance
    assert (moved.cameras.rotation - expected.rotation).abs().max() < tolerance
    assert moved.recipe == plan.recipe
    assert moved.reasons == plan.reasons
    assert moved.groups == plan.groups
    assert torch.equal(moved.path, plan.path)
    assert torch.equal(moved.window, plan.window)
