"""Depth and surface errors of the evaluate stage, against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from cat3d_core.cameras import Cameras
from cat3d_core.metrics.measures import METRICS, Comparison


def geometry_row(depth: np.ndarray, opacity: np.ndarray, truth: np.ndarray, camera: Cameras) -> dict[str, float]:
    """Depth and surface errors, without those that don't apply."""
    black = torch.zeros(3, *depth.shape)
    view = Comparison("google", black, black, None, *map(torch.from_numpy, (depth, opacity, truth)), camera)
    found = {m.name: m.measure(view) for m in METRICS if m.name in ("depth_abs_rel", "surface_chamfer")}
    return {name: number for name, number in found.items() if number is not None}


def camera(size: int = 16) -> Cameras:
    """At the origin's z = -1, looking along +z at a plane through the origin, 90 degrees wide."""
    intrinsics = torch.tensor([[size / 2, 0.0, size / 2], [0.0, size / 2, size / 2], [0.0, 0.0, 1.0]]).double()
    pose = torch.eye(4, dtype=torch.float64)
    pose[2, 3] = -1.0
    return Cameras(intrinsics[None], pose[None], torch.tensor([[size, size]]))


def test_a_plane_in_front_and_sky_around_it():
    truth = np.full((16, 16), np.inf, np.float32)
    truth[2:14, 2:14] = 1.0
    opaque = np.ones((16, 16), np.float32)
    assert geometry_row(truth, opaque, truth, camera()) == {"depth_abs_rel": 0.0, "surface_chamfer": 0.0}
    # 5 % too far: the nearest true point is the plane's own, straight ahead, within half a pixel's spacing.
    row = geometry_row(np.full((16, 16), 1.05, np.float32), np.isfinite(truth).astype(np.float32), truth, camera())
    assert row["depth_abs_rel"] == pytest.approx(0.05, abs=1e-6)
    assert 0.05 <= row["surface_chamfer"] < (0.05**2 + 2 * 0.0625**2) ** 0.5


def test_truth_of_another_size_and_no_surface():
    truth = np.full((32, 32), 2.0, np.float32)
    assert geometry_row(np.full((16, 16), 2.0), np.ones((16, 16)), truth, camera())["surface_chamfer"] == 0.0
    assert geometry_row(np.full((16, 16), 2.0), np.zeros((16, 16)), truth, camera()) == {"depth_abs_rel": 0.0}
    assert geometry_row(np.full((16, 16), 2.0), np.ones((16, 16)), np.full((32, 32), np.inf), camera()) == {}


def test_without_a_known_depth_there_are_no_errors_of_it():
    black, opaque = torch.zeros(3, 16, 16), torch.ones(16, 16)
    for metric in METRICS:
        if metric.name in ("depth_abs_rel", "surface_chamfer"):
            assert metric.measure(Comparison("google", black, black, None, opaque, opaque, None, camera())) is None
