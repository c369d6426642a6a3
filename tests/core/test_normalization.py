"""One similarity per scene: robust, invertible, moving with the world."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from cat3d_core.cameras import Cameras
from cat3d_core.normalization import normalize_scene
from tests.core.strategies import intrinsics, look_at, orbit, random_similarity, seeds


@given(seeds, st.integers(1, 12))
def test_orbit_is_centred_at_unit_distance_with_up_along_z(seed: int, count: int) -> None:
    world = random_similarity(seed)
    cameras = normalize_scene(world.cameras(orbit(count, seed=seed))).cameras(world.cameras(orbit(count, seed=seed)))
    assert float(cameras.centers.norm(dim=-1).mean()) == pytest.approx(1, abs=0.05)
    assert float(cameras.up[:, 2].mean()) > 0.9
    towards_origin = -(cameras.centers * cameras.forward).sum(-1) / cameras.centers.norm(dim=-1)
    assert float(towards_origin.min()) > 0.95


@given(seeds, st.integers(2, 9), st.booleans())
def test_result_does_not_depend_on_the_world_frame(seed: int, count: int, with_points: bool) -> None:
    cameras = orbit(count, seed=seed)
    g = torch.Generator().manual_seed(seed)
    points = 0.5 * torch.randn(40, 3, generator=g, dtype=torch.float64) if with_points else None
    world = random_similarity(seed + 1)
    here = normalize_scene(cameras, points).cameras(cameras)
    moved = world.cameras(cameras)
    there = normalize_scene(moved, world.points(points) if with_points else None).cameras(moved)
    torch.testing.assert_close(there.world_from_camera, here.world_from_camera, rtol=0, atol=1e-7)


@given(seeds)
def test_similarity_inverts_exactly(seed: int) -> None:
    similarity = random_similarity(seed)
    points = torch.randn(9, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    back = similarity.inverse().points(similarity.points(points))
    torch.testing.assert_close(back, points, rtol=1e-10, atol=1e-10)
    cameras = orbit(4, seed=seed)
    round_trip = similarity.inverse().cameras(similarity.cameras(cameras))
    torch.testing.assert_close(round_trip.world_from_camera, cameras.world_from_camera, rtol=1e-9, atol=1e-9)


def at(centers: list[list[float]], target=(0.0, 0.0, 0.0)) -> Cameras:
    c = torch.tensor(centers, dtype=torch.float64)
    pose = look_at(c, torch.tensor(target, dtype=torch.float64))
    return Cameras(intrinsics(len(c), 64, 48, 60.0), pose, torch.tensor([[64, 48]]).repeat(len(c), 1))


def parallel(centers: list[list[float]]) -> Cameras:
    cameras = at(centers)
    pose = cameras.world_from_camera.clone()
    pose[:, :3, :3] = pose[0, :3, :3]
    return Cameras(cameras.intrinsics, pose, cameras.size)


@pytest.mark.parametrize(
    ("cameras", "method"),
    [
        (at([[3, 0, 1]]), "unit"),
        (at([[3, 0, 1], [3, 0, 1]]), "unit"),  # coincident
        (at([[1e6, 0, 1]]), "unit"),
        (parallel([[0, 3, 0], [0.5, 3, 0], [1, 3, 0]]), "extent"),  # collinear, parallel axes
        (at([[3, 0, 0], [-3, 0, 0]]), "extent"),  # 180 degrees apart: the axes are one line
        (at([[3, 0, 0], [0, 3, 0], [-3, 0, 1]]), "convergence"),
    ],
)
def test_degenerate_layouts_give_a_finite_answer(cameras: Cameras, method: str) -> None:
    similarity = normalize_scene(cameras)
    assert similarity.method == method
    out = similarity.cameras(cameras)
    assert torch.isfinite(out.world_from_camera).all()
    assert 0 < similarity.scale < 1e9
    out.validate()


def test_looking_straight_down_has_a_frame() -> None:
    c = torch.tensor([[0.0, 0, 3], [0.1, 0, 3]], dtype=torch.float64)
    pose = look_at(c, torch.zeros(3, dtype=torch.float64), up=torch.tensor([0.0, 1, 0], dtype=torch.float64))
    cameras = Cameras(intrinsics(2, 64, 48, 60.0), pose, torch.tensor([[64, 48]] * 2))
    normalize_scene(cameras).cameras(cameras).validate()


def test_depth_is_taken_from_points_then_bounds() -> None:
    cameras = parallel([[0, 3, 0], [0.1, 3, 0]])
    g = torch.Generator().manual_seed(0)
    points = 0.3 * torch.randn(50, 3, generator=g, dtype=torch.float64)
    assert normalize_scene(cameras, points).method == "points"
    assert normalize_scene(cameras, points).scale == pytest.approx(1 / 3, rel=0.1)
    bounds = torch.tensor([[2.0, 6.0], [2.0, 6.0]], dtype=torch.float64)
    assert normalize_scene(cameras, depth_bounds=bounds).scale == pytest.approx(1 / 3)
    flat = torch.tensor([[4.0, 4.0], [4.0, 4.0]], dtype=torch.float64)  # near and far are one plane
    assert normalize_scene(cameras, depth_bounds=flat).scale == pytest.approx(1 / 4)
    nonsense = torch.tensor([[0.0, -1.0], [float("nan"), 2.0]], dtype=torch.float64)
    assert normalize_scene(cameras, depth_bounds=nonsense).method == "extent"


def test_no_or_broken_cameras_are_refused() -> None:
    with pytest.raises(ValueError, match="without cameras"):
        normalize_scene(orbit(2)[[]])
    broken = orbit(2)
    broken.world_from_camera[0, 0, 3] = float("nan")
    with pytest.raises(ValueError, match="NaN or infinite"):
        normalize_scene(broken)
