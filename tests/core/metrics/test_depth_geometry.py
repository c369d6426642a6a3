"""Depth and surface errors against closed forms and scipy's k-d tree. Tolerance 1e-6 (float32), 1e-12 (float64)."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from cat3d_core.metrics.depth import depth_errors
from cat3d_core.metrics.geometry import chamfer_distance, nearest_distances


@given(scale=st.floats(0.1, 10), seed=st.integers(0, 1000))
def test_scaled_depth_has_closed_form_errors_and_aligns_away(scale, seed):
    target = 0.5 + torch.rand(2, 6, 7, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    errors = depth_errors(target * scale, target)
    torch.testing.assert_close(errors["abs_rel"], torch.full((2,), abs(scale - 1), dtype=torch.float64))
    rmse = abs(scale - 1) * target.square().mean(dim=(1, 2)).sqrt()
    torch.testing.assert_close(errors["rmse"], rmse)
    assert bool((errors["delta_1.25"] == float(0.8 < scale < 1.25)).all()) or abs(scale - 0.8) < 1e-9
    aligned = depth_errors(target * scale, target, align="median")
    assert float(aligned["abs_rel"].max()) < 1e-12


def test_only_known_depths_count():
    target = torch.ones(1, 3, 3)
    target[0, 0] = torch.tensor([0.0, torch.inf, torch.nan])
    prediction = torch.full((1, 3, 3), 2.0)
    prediction[0, 0] = torch.nan
    prediction[0, 1] = 1.0
    assert float(depth_errors(prediction, target)["abs_rel"]) == 0.5
    mask = torch.zeros(1, 3, 3, dtype=torch.bool)
    mask[0, 1] = True
    assert float(depth_errors(prediction, target, mask)["abs_rel"]) == 0.0


@pytest.mark.parametrize(
    ("prediction", "target", "align", "message"),
    [
        (torch.ones(1, 2, 2), torch.ones(1, 2, 3), "none", r"expected both \(B, H, W\)"),
        (torch.ones(1, 2, 2), torch.zeros(1, 2, 2), "none", "View 0 has no pixel with a known depth"),
        (torch.full((1, 2, 2), torch.nan), torch.ones(1, 2, 2), "none", "of view 0 holds NaN"),
        (torch.zeros(1, 2, 2), torch.ones(1, 2, 2), "median", "no positive median"),
        (torch.ones(1, 2, 2), torch.ones(1, 2, 2), "mean", "no depth alignment 'mean'"),
    ],
)
def test_depth_errors_are_sentences(prediction, target, align, message):
    with pytest.raises(ValueError, match=message):
        depth_errors(prediction, target, align=align)


@pytest.mark.parametrize("offset", [0.0, 1000.0])
@pytest.mark.parametrize("chunk", [1, 1000, 1 << 24])
def test_nearest_distances_against_a_tree(offset, chunk):
    rng = np.random.default_rng(0)
    a, b = (rng.random((n, 3)).astype(np.float32) + np.float32(offset) for n in (300, 211))
    expected = cKDTree(b.astype(np.float64)).query(a.astype(np.float64))[0]
    ours = nearest_distances(torch.from_numpy(a), torch.from_numpy(b), chunk)
    np.testing.assert_allclose(ours.numpy(), expected, rtol=1e-6, atol=1e-9)


def test_chamfer_of_shifted_planes():
    grid = torch.cartesian_prod(*[torch.arange(8.0)] * 2)
    plane = torch.cat([grid, torch.zeros(64, 1)], dim=1)
    lifted = plane + torch.tensor([0.0, 0.0, 0.25])
    result = chamfer_distance(lifted, plane, threshold=0.3)
    assert result == {"accuracy": 0.25, "completeness": 0.25, "chamfer": 0.25, "precision": 1, "recall": 1, "fscore": 1}
    assert chamfer_distance(lifted, plane, threshold=0.2)["fscore"] == 0.0
    half = chamfer_distance(plane[:32], plane)
    assert half["accuracy"] == 0.0
    assert half["completeness"] == pytest.approx((1 + 2 + 3 + 4) * 8 / 64)


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (torch.zeros(0, 3), "at least one point"),
        (torch.zeros(4, 2), r"expected \(P, 3\)"),
        (torch.full((2, 3), torch.inf), "NaN or infinite"),
    ],
)
def test_chamfer_errors_are_sentences(points, message):
    with pytest.raises(ValueError, match=message):
        chamfer_distance(points, torch.zeros(1, 3))
    with pytest.raises(ValueError, match=message):
        chamfer_distance(torch.zeros(1, 3), points)


def test_f_score_is_the_harmonic_mean_of_precision_and_recall():
    """Half of a plane's points and as many far away: half of them are right, a quarter of the plane is found."""
    plane = torch.cat([torch.cartesian_prod(*[torch.arange(8.0)] * 2), torch.zeros(64, 1)], dim=1)
    points = torch.cat([plane[:16], plane[:16] + 100])
    result = chamfer_distance(points, plane, threshold=0.5)
    assert (result["precision"], result["recall"]) == (0.5, 0.25)
    assert result["fscore"] == pytest.approx(2 * 0.5 * 0.25 / 0.75)
