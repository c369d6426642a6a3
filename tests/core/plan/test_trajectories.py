"""The paper's recipes: exact counts, views that look where they should, spacing, free space, degenerate captures."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from cat3d_core.cameras import Cameras
from cat3d_core.splines import rotation_angle
from cat3d_core.trajectories import (
    RECIPES,
    FreeSpace,
    Shift,
    build_trajectory,
    estimate_up,
    look_at,
    scene_frame,
)
from cat3d_core.trajectories.paths import ellipse, forward_circle, orbit, spiral, spline, spline_around
from cat3d_core.trajectories.recipes import views_of_paths
from tests.core.plan.layouts import FAMILIES, arc, cameras, forward_facing, patch, ring, single, walk
from tests.core.strategies import random_similarity, seeds

F64 = torch.float64
PAPER_COUNTS = {
    "single_spiral": 80,
    "single_orbit": 80,
    "realestate10k": 800,
    "llff": 960,
    "dtu": 480,
    "co3d": 640,
    "mipnerf360": 720,
}
OWN_CAPTURE = {**{name: make() for name, make in FAMILIES.items()}, "single_spiral": single(), "single_orbit": single()}


def trajectory(name: str, captured: Cameras, count: int | None = None, points: torch.Tensor | None = None):  # type: ignore[no-untyped-def]
    frame = scene_frame(captured, points)
    free = FreeSpace.of(captured, frame, points)
    poses, path, reasons = build_trajectory(RECIPES[name], frame, captured, free, count)
    n = len(poses)
    k = captured.intrinsics[:1].expand(n, 3, 3)
    return Cameras(k, poses, captured.size[:1].expand(n, 2)), path, reasons, frame


@pytest.mark.parametrize("name", sorted(RECIPES))
def test_recipes_have_the_papers_counts_in_paths_of_eighty(name: str) -> None:
    views, path, _, _ = trajectory(name, OWN_CAPTURE[name])
    assert len(views) == PAPER_COUNTS[name]
    assert path.unique(return_counts=True)[1].tolist() == [80] * (PAPER_COUNTS[name] // 80)
    views.validate()


@pytest.mark.parametrize("name", sorted(RECIPES))
def test_every_view_sees_the_centre_upright(name: str) -> None:
    views, _, _, frame = trajectory(name, OWN_CAPTURE[name], count=160)
    assert ((views.up @ frame.up) > 0).all()
    if name != "realestate10k":  # a walk passes what it looks at
        pixels, depth = views.project(frame.center[None])
        assert (depth > 0).all()
        assert ((pixels >= 0) & (pixels <= views.size[:, None])).all()
    if RECIPES[name].looks_at_center:
        aim = (frame.center - views.centers) / (frame.center - views.centers).norm(dim=-1, keepdim=True)
        assert torch.allclose(aim, views.forward, atol=1e-9)
        # Level horizon: the image's right axis is across the scene's up.
        assert (views.rotation[:, :, 0] @ frame.up).abs().max() < 1e-9


@pytest.mark.parametrize("name", sorted(RECIPES))
@settings(max_examples=10)
@given(seed=seeds)
def test_trajectories_move_with_the_world(name: str, seed: int) -> None:
    captured = OWN_CAPTURE[name]
    g = random_similarity(seed, scaled=len(captured) > 1)  # one camera alone has no scale
    here, path, reasons, frame = trajectory(name, captured, count=60)
    there, moved_path, moved_reasons, moved_frame = trajectory(name, g.cameras(captured), count=60)
    expected = g.cameras(here)
    assert (there.centers - expected.centers).norm(dim=-1).max() < 1e-6 * moved_frame.distance
    assert torch.allclose(there.rotation, expected.rotation, atol=1e-6)
    assert torch.equal(path, moved_path)
    assert reasons == moved_reasons
    assert moved_frame.distance == pytest.approx(g.scale * frame.distance, rel=1e-9)


@pytest.mark.parametrize("curve", [orbit, ellipse, forward_circle, spiral, spline, spline_around])
def test_views_are_evenly_spaced_along_each_curve(curve) -> None:  # type: ignore[no-untyped-def]
    captured = patch() if curve is forward_circle else arc()
    frame = scene_frame(captured)
    poses = curve(frame, captured, 120, Shift())
    step = poses[:, :3, 3].diff(dim=0).norm(dim=-1)
    if curve in (spline, spline_around):
        turn = rotation_angle(poses[:-1, :3, :3], poses[1:, :3, :3])
        step = torch.hypot(step / frame.distance, turn)
    assert step.max() / step.min() < 1.02


@pytest.mark.parametrize("curve", [spline, spline_around])
@pytest.mark.parametrize("make", [arc, ring, walk, forward_facing])
def test_splines_pass_near_every_captured_view(curve, make) -> None:  # type: ignore[no-untyped-def]
    captured = make()
    frame = scene_frame(captured)
    poses = curve(frame, captured, 2000, Shift())
    gap = torch.cdist(captured.centers, poses[:, :3, 3])
    assert gap.amin(1).max() < 0.01 * frame.distance
    nearest = gap.argmin(1)
    assert rotation_angle(poses[nearest, :3, :3], captured.rotation).max() < 0.02


def test_two_views_half_a_turn_apart_go_round_the_object_at_their_height() -> None:
    captured = cameras(torch.tensor([[1.0, 0, 0.5], [-1.0, 0, 0.5]], dtype=F64))
    frame = scene_frame(captured)
    poses = spline_around(frame, captured, 41, Shift())
    centers = poses[:, :3, 3]
    assert torch.allclose(centers[:, 2], torch.full((41,), 0.5, dtype=F64), atol=1e-6)
    assert torch.allclose(centers[:, :2].norm(dim=-1), torch.ones(41, dtype=F64), atol=1e-6)
    assert rotation_angle(poses[:-1, :3, :3], poses[1:, :3, :3]).max() < math.radians(5)


def test_ellipse_is_recovered_from_cameras_on_it() -> None:
    angle = torch.linspace(0, 2 * math.pi, 13, dtype=F64)[:-1]
    captured = cameras(torch.stack([1.3 * angle.cos(), 0.9 * angle.sin(), 0.3 + 0 * angle], -1))
    poses = ellipse(scene_frame(captured), captured, 400, Shift())
    x, y, z = poses[:, :3, 3].unbind(-1)
    assert ((x / 1.3) ** 2 + (y / 0.9) ** 2 - 1).abs().max() < 0.1  # drawn to the circle by half a camera
    assert torch.allclose(z, torch.full_like(z, 0.3), atol=1e-6)


def test_up_is_level_though_every_camera_looks_down() -> None:
    # Views along a quarter of a circle, all looking 45 degrees down: the mean of their ups leans by much.
    captured = cameras(torch.stack([torch.tensor([math.cos(a), math.sin(a), 1.0]) for a in (0, 0.5, 1, 1.5)]).double())
    up = estimate_up(captured)
    mean = captured.up.mean(0) / captured.up.mean(0).norm()
    assert torch.rad2deg(torch.acos(up[2])) < 6
    assert torch.rad2deg(torch.acos(mean[2])) > 35


def test_pitch_of_a_single_view_levels_its_orbit() -> None:
    captured = cameras(torch.tensor([[0.0, -1.0, 1.0]], dtype=F64))
    frame = scene_frame(captured, pitch_down_deg=45.0)
    assert torch.allclose(frame.up, torch.tensor([0, 0, 1.0], dtype=F64), atol=1e-9)
    heights = orbit(frame, captured, 20, Shift())[:, 2, 3]
    assert torch.allclose(heights, torch.ones(20, dtype=F64), atol=1e-9)


def test_look_at_along_up_uses_the_hint_and_stays_a_rotation() -> None:
    up, hint = torch.tensor([0, 0, 1.0], dtype=F64), torch.tensor([1.0, 0, 0], dtype=F64)
    centers = torch.tensor([[0, 0, 3.0], [0, 0, -3.0], [0, 0, 0]], dtype=F64)
    poses = look_at(centers, torch.zeros(3, dtype=F64), up, hint)
    Cameras(torch.eye(3, dtype=F64).repeat(3, 1, 1), poses, torch.tensor([[4, 4]] * 3)).validate()
    assert torch.allclose(poses[:, :3, 0], hint.expand(3, 3))
    assert torch.allclose(poses[2, :3, 2], torch.tensor([0, 1.0, 0], dtype=F64))


@given(st.integers(1, 12), st.integers(1, 1200))
def test_path_counts_add_up_and_small_plans_keep_whole_paths(paths: int, count: int) -> None:
    views = views_of_paths(paths, count)
    assert sum(views) == count
    used = [v for v in views if v]
    assert min(used) >= min(count, 20)
    assert max(used) - min(used) <= 1


@pytest.mark.parametrize("count", [40, 80])
@pytest.mark.parametrize("name", sorted(RECIPES))
def test_small_counts(name: str, count: int) -> None:
    views, path, _, _ = trajectory(name, OWN_CAPTURE[name], count)
    assert len(views) == len(path) == count


def test_cameras_keep_clear_of_points() -> None:
    g = torch.Generator().manual_seed(0)
    captured = ring(8)
    # A pillar on the ring, between two captured views, and the object in the middle.
    angle = math.radians(22.5)
    pillar = torch.tensor([math.cos(angle), math.sin(angle), 0.4], dtype=F64) * torch.tensor([0.9, 0.9, 1.0])
    points = torch.cat(
        [pillar + 0.03 * torch.randn(60, 3, generator=g), 0.1 * torch.randn(200, 3, generator=g)]
    ).double()
    views, _, reasons, frame = trajectory("mipnerf360", captured, 180, points)
    free = FreeSpace.of(captured, frame, points)
    assert not free.blocked(views.centers).any()
    assert any("moved towards the nearest captured camera" in r for r in reasons)
    # Without the points the same plan would go through the pillar.
    assert free.blocked(trajectory("mipnerf360", captured, 180)[0].centers).any()


def test_a_wall_ahead_shortens_the_walk() -> None:
    captured = forward_facing()
    g = torch.Generator().manual_seed(1)
    wall = torch.rand(4000, 3, generator=g, dtype=F64) * torch.tensor([1.6, 0.01, 1.2]) - torch.tensor([0.8, 0.82, 0.6])
    views, _, _, frame = trajectory("llff", captured, 240, wall)
    assert (views.centers[:, 1] < -0.82).all()
    far, *_ = trajectory("llff", captured, 240)
    assert far.centers[:, 1].max() > views.centers[:, 1].max()
    assert frame.near == pytest.approx(0.18, abs=0.03)


def test_behind_a_seen_surface_is_blocked_and_far_behind_it_is_unknown() -> None:
    captured = forward_facing()
    g = torch.Generator().manual_seed(1)
    wall = torch.rand(4000, 3, generator=g, dtype=F64) * torch.tensor([1.6, 0.01, 1.2]) - torch.tensor([0.8, 0.0, 0.6])
    frame = scene_frame(captured, wall)
    free = FreeSpace.of(captured, frame, wall)
    probe = torch.tensor([[0, -0.5, 0], [0, -0.05, 0], [0, 0.2, 0], [0, 2.0, 0], [0, -3.0, 0]], dtype=F64)
    assert free.blocked(probe).tolist() == [False, True, True, False, False]


@pytest.mark.parametrize("name", sorted(RECIPES))
@pytest.mark.parametrize("case", ["one", "coincident", "collinear", "half_turn", "one_height", "vertical"])
def test_degenerate_captures_give_finite_rigid_views(name: str, case: str) -> None:
    ahead = torch.tensor([0.0, 1.0, 0.0], dtype=F64)
    centers = {
        "one": [[0.0, -1.0, 0.0]],
        "coincident": [[0.0, -1.0, 0.0]] * 3,
        "collinear": [[0.1 * i, -1.0, 0.0] for i in range(4)],
        "half_turn": [[0.0, -1.0, 0.0], [0.0, 1.0, 0.0]],
        "one_height": [[math.cos(a), math.sin(a), 0.0] for a in (0.0, 2.0, 4.0)],
        "vertical": [[0.0, 0.0, 2.0], [0.1, 0.0, 2.0]],
    }[case]
    c = torch.tensor(centers, dtype=F64)
    if case == "vertical":  # straight down
        frame_axes = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=F64)).repeat(2, 1, 1)
        frame_axes[:, :3, 3] = c
        captured = Cameras(cameras(c + 1).intrinsics, frame_axes, cameras(c + 1).size)
    else:
        captured = cameras(c, c + ahead if case == "collinear" else None)
    views, *_ = trajectory(name, captured, 60)
    views.validate()
    assert len(views) == 60


def test_overrides_replace_scales_and_shifts_and_faulty_ones_are_refused() -> None:
    recipe = RECIPES["llff"].with_shifts(scales=[0.5], forwards=(0.0, 0.2))
    assert [(s.scale, s.forward) for s in recipe.shifts] == [(0.5, 0.0), (0.5, 0.2)]
    assert recipe.count == 160
    with pytest.raises(ValueError, match="scales above 0"):
        RECIPES["llff"].with_shifts(scales=(0.0,))


def test_partial_orbit_stays_on_the_captured_side() -> None:
    captured = patch()
    views, _, _, frame = trajectory("dtu", captured)
    assert ((views.forward @ frame.forward) > 0).all()


def test_the_forward_circle_is_closed_and_evenly_spaced() -> None:
    """As many equal steps as views: the last one leads back to the first view, without standing there twice."""
    captured = forward_facing()
    frame = scene_frame(captured)
    centers = forward_circle(frame, captured, 40, Shift())[:, :3, 3]
    step = (centers.roll(-1, 0) - centers).norm(dim=-1)
    torch.testing.assert_close(step, step.mean().expand(40), rtol=5e-3, atol=0)
