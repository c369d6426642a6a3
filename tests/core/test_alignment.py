"""Similarity alignment against closed forms, and on degenerate camera sets."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from cat3d_core.alignment import align_cameras, pose_errors, rotation_angle_deg, umeyama
from cat3d_core.cameras import Cameras
from cat3d_core.normalization import Similarity


def _rotation(generator: torch.Generator) -> torch.Tensor:
    q, r = torch.linalg.qr(torch.randn(3, 3, generator=generator, dtype=torch.float64))
    q = q * torch.diagonal(r).sign()
    return q * torch.linalg.det(q)


def _similarity(seed: int) -> tuple[Similarity, torch.Generator]:
    g = torch.Generator().manual_seed(seed)
    scale = math.exp(float(torch.randn(1, generator=g)))
    return Similarity(scale, _rotation(g), 5 * torch.randn(3, generator=g, dtype=torch.float64)), g


def _cameras(centers: torch.Tensor, g: torch.Generator) -> Cameras:
    poses = torch.eye(4, dtype=torch.float64).repeat(len(centers), 1, 1)
    for pose, center in zip(poses, centers, strict=True):
        pose[:3, :3], pose[:3, 3] = _rotation(g), center
    return Cameras(
        torch.eye(3, dtype=torch.float64).repeat(len(centers), 1, 1), poses, torch.ones(len(centers), 2).long()
    )


@given(st.integers(0, 10**6), st.integers(4, 30))
def test_umeyama_recovers_an_exact_similarity(seed, count):
    similarity, g = _similarity(seed)
    points = torch.randn(count, 3, generator=g, dtype=torch.float64)
    found = umeyama(points, similarity.points(points))
    assert found.scale == pytest.approx(similarity.scale, rel=1e-10)
    torch.testing.assert_close(found.rotation, similarity.rotation, atol=1e-9, rtol=0)
    torch.testing.assert_close(found.translation, similarity.translation, atol=1e-8, rtol=0)


def test_umeyama_of_a_planar_mirror_image():
    # The points of the example in Umeyama 1991, section IV, there in the plane.
    x = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 2, 0]], dtype=torch.float64)
    y = torch.tensor([[0.0, 0, 0], [-1, 0, 0], [0, 2, 0]], dtype=torch.float64)
    found = umeyama(x[:, :3], y[:, :3])
    # In three dimensions the planar mirror image is a rotation by 180 degrees about y: an exact fit.
    assert found.scale == pytest.approx(1.0, abs=1e-12)
    torch.testing.assert_close(found.points(x), y, atol=1e-12, rtol=0)
    assert torch.linalg.det(found.rotation) == pytest.approx(1.0)


@given(st.integers(0, 10**6))
def test_umeyama_is_a_least_squares_optimum(seed):
    g = torch.Generator().manual_seed(seed)
    x, y = (torch.randn(12, 3, generator=g, dtype=torch.float64) for _ in range(2))
    best = umeyama(x, y)
    cost = (best.points(x) - y).square().sum()
    assert torch.linalg.det(best.rotation) == pytest.approx(1.0)
    for _ in range(8):
        w = 1e-3 * torch.randn(3, generator=g, dtype=torch.float64)
        skew = torch.tensor([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
        other = Similarity(
            best.scale * (1 + 1e-3 * float(torch.randn(1, generator=g))),
            torch.linalg.matrix_exp(skew) @ best.rotation,
            best.translation + 1e-3 * torch.randn(3, generator=g, dtype=torch.float64),
        )
        assert (other.points(x) - y).square().sum() >= cost - 1e-12


def test_umeyama_of_mirrored_points_stays_a_rotation():
    g = torch.Generator().manual_seed(0)
    x = torch.randn(10, 3, generator=g, dtype=torch.float64)
    assert torch.linalg.det(umeyama(x, x * torch.tensor([-1.0, 1, 1])).rotation) == pytest.approx(1.0)


@pytest.mark.parametrize("points", [torch.zeros(5, 3), torch.arange(5.0)[:, None] * torch.tensor([1.0, 2, 3])])
def test_umeyama_refuses_degenerate_points(points):
    with pytest.raises(ValueError, match="collinear or coincident"):
        umeyama(points, points)


def test_umeyama_refuses_too_few_and_non_finite_points():
    with pytest.raises(ValueError, match="at least three points"):
        umeyama(torch.zeros(2, 3), torch.zeros(2, 3))
    with pytest.raises(ValueError, match="NaN or infinite"):
        umeyama(torch.full((4, 3), math.nan), torch.zeros(4, 3))
    one = torch.randn(4, 3, generator=torch.Generator().manual_seed(0))
    one[2, 1] = math.inf
    for pair in ((one, torch.randn(4, 3)), (torch.randn(4, 3), one)):
        with pytest.raises(ValueError, match="NaN or infinite"):
            umeyama(*pair)


@pytest.mark.parametrize("kind", ["general", "collinear", "coincident", "two", "one"])
def test_align_cameras_recovers_the_similarity_of_any_layout(kind):
    similarity, g = _similarity(3)
    centers = {
        "general": torch.randn(6, 3, generator=g, dtype=torch.float64),
        "collinear": torch.arange(5.0, dtype=torch.float64)[:, None] * torch.tensor([1.0, 2, 3], dtype=torch.float64),
        "coincident": torch.ones(4, 3, dtype=torch.float64),
        "two": torch.tensor([[0.0, 0, 0], [1, 0, 0]], dtype=torch.float64),
        "one": torch.tensor([[3.0, 4, 5]], dtype=torch.float64),
    }[kind]
    cameras = _cameras(centers, g)
    truth = similarity.cameras(cameras)
    found = align_cameras(cameras, truth)
    assert found.scale == pytest.approx(1.0 if kind in ("coincident", "one") else similarity.scale, rel=1e-9)
    torch.testing.assert_close(found.rotation, similarity.rotation, atol=1e-9, rtol=0)
    aligned = found.cameras(cameras)
    torch.testing.assert_close(aligned.world_from_camera, truth.world_from_camera, atol=1e-8, rtol=0)


def test_pose_errors_measure_a_known_disturbance():
    g = torch.Generator().manual_seed(1)
    truth = _cameras(torch.randn(40, 3, generator=g, dtype=torch.float64), g)
    errors = pose_errors(truth, truth)
    assert errors.rotation_deg.max() < 1e-6
    assert errors.center_share.max() < 1e-10
    poses = truth.world_from_camera.clone()
    angle = math.radians(2.0)
    turn = torch.tensor([[1, 0, 0], [0, math.cos(angle), -math.sin(angle)], [0, math.sin(angle), math.cos(angle)]])
    poses[7, :3, :3] = poses[7, :3, :3] @ turn.double()
    errors = pose_errors(Cameras(truth.intrinsics, poses, truth.size), truth)
    assert errors.rotation_deg[7].item() == pytest.approx(2.0, abs=0.1)
    assert errors.rotation_deg.median() < 0.1


@given(st.floats(1e-9, 179.9))
def test_rotation_angle_against_its_construction(degrees):
    a = math.radians(degrees)
    turn = torch.tensor([[math.cos(a), -math.sin(a), 0], [math.sin(a), math.cos(a), 0], [0, 0, 1]], dtype=torch.float64)
    found = rotation_angle_deg(torch.eye(3, dtype=torch.float64)[None], turn[None])
    assert found.item() == pytest.approx(degrees, rel=1e-6, abs=1e-9)


def test_align_cameras_of_none_is_refused():
    none = Cameras(torch.zeros(0, 3, 3), torch.zeros(0, 4, 4), torch.zeros(0, 2).long())
    with pytest.raises(ValueError, match="no cameras"):
        align_cameras(none, none)
