"""What a scene needs no generated views for: places seen from nearby, certain rays, and the sampler's evaluations."""

from __future__ import annotations

import math

import pytest
import torch

from cat3d_core.cameras import Cameras
from cat3d_core.coverage import seen_from_nearby, voxel_grid
from cat3d_core.diffusion import GuidanceConfig, SamplerConfig, Schedule, sample
from cat3d_core.diffusion.sampler import evaluations
from cat3d_core.plan import COVERED_DEG, PlanConfig, make_plan
from cat3d_core.rays import image_rays
from cat3d_core.trajectories import scene_frame
from cat3d_core.uncertainty import ray_entropy, shown_by, unseen
from tests.core.diffusion.models import random_model
from tests.core.plan.layouts import ring


def around(degrees: list[float], distance: float = 1.0) -> Cameras:
    """Level cameras that look at the origin from these azimuths."""
    poses = []
    for angle in degrees:
        c, s = math.cos(math.radians(angle)), math.sin(math.radians(angle))
        forward = torch.tensor([-c, -s, 0.0], dtype=torch.float64)
        down = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64)
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, :3] = torch.stack([torch.linalg.cross(down, forward), down, forward], 1)
        pose[:3, 3] = -distance * forward
        poses.append(pose)
    intrinsics = torch.tensor([[50.0, 0, 32], [0, 50, 32], [0, 0, 1]], dtype=torch.float64)
    count = len(degrees)
    return Cameras(intrinsics.expand(count, 3, 3), torch.stack(poses), torch.full((count, 2), 64))


def test_a_place_is_seen_from_nearby_up_to_the_angle_and_at_any_distance() -> None:
    origin = torch.zeros(1, 3, dtype=torch.float64)
    views = around([0, 9.9, 10.1, 180])
    assert seen_from_nearby(views, around([0], distance=3.0), origin, 10.0).tolist() == [1, 1, 0, 0]
    away = around([0])
    about = torch.diag(torch.tensor([-1.0, 1, -1, 1], dtype=torch.float64))
    turned = Cameras(away.intrinsics, away.world_from_camera @ about, away.size)
    assert seen_from_nearby(views, turned, origin, 10.0).tolist() == [0, 0, 0, 0], "it looks the other way"
    assert seen_from_nearby(turned, away, origin, 10.0).tolist() == [1], "a view that sees nothing lacks nothing"


def test_nothing_is_planned_to_be_sampled_where_captured_views_cover_the_path() -> None:
    dense, sparse = ring(48), ring(4)
    config = PlanConfig(count=40, image_size=32, covered_share=0.9)
    covered = make_plan(dense, config)
    assert not covered.needed
    assert any("need not be generated" in r for r in covered.reasons)
    frame = scene_frame(dense)
    share = seen_from_nearby(covered.cameras, dense, voxel_grid(frame), COVERED_DEG)
    assert share.mean() > 0.9
    assert make_plan(sparse, config).needed
    assert make_plan(dense, PlanConfig(count=40, image_size=32)).needed, "without the switch nothing is skipped"


def test_the_entropy_of_a_ray_is_zero_where_it_ends_for_sure_and_one_where_it_may_end_anywhere() -> None:
    certain = torch.eye(4, dtype=torch.float64)[:3]
    anywhere = torch.full((1, 3), 0.25, dtype=torch.float64)  # a quarter passes
    nothing = torch.zeros(1, 3, dtype=torch.float64)
    assert ray_entropy(certain[:, :3]).tolist() == [0, 0, 0]
    torch.testing.assert_close(ray_entropy(anywhere), torch.ones(1, dtype=torch.float64))
    assert ray_entropy(nothing).tolist() == [0], "it surely ends nowhere"
    half = torch.tensor([[0.5, 0.5, 0.0]], dtype=torch.float64)
    torch.testing.assert_close(ray_entropy(half), torch.tensor([0.5], dtype=torch.float64))


def test_unseen_places_are_those_in_no_image() -> None:
    points = torch.tensor([[0.0, 0, 0], [0, 0, 5], [2, 0, 0]], dtype=torch.float64)
    assert unseen(points, around([0])).tolist() == [False, True, True], "beside and behind the camera"
    assert unseen(points, around([0, 180])).tolist() == [False, True, False]


def wall_depth(camera: Cameras, width: int, height: int) -> torch.Tensor:
    """(height, width) z-depth of the plane y = 0 as the camera sees it."""
    rays = image_rays(camera, 0, width, height)
    return (-rays.origins[:, 1] / rays.directions[:, 1]).view(height, width)


@pytest.mark.parametrize("side", [64, 31])
def test_pixels_whose_place_another_view_shows(side: int) -> None:
    views = around([80, 100, 260])  # two before the wall, the third behind it
    depths = [wall_depth(views[[v]], side, side) for v in range(3)]
    first = views[[0]]
    assert (shown_by(depths[0], first, first, depths[:1]) == 1).all(), "a view shows what it shows"
    both = shown_by(depths[0], first, views[[1]], depths[1:2]) == 1
    rays = image_rays(first, 0, side, side)
    pixels, _ = views[[1]].project(rays.origins + depths[0].reshape(-1, 1) * rays.directions)
    inside = ((pixels[0] >= 0) & (pixels[0] < 64)).all(-1).view(side, side)
    assert 0.5 < both.double().mean() < 1
    assert torch.equal(both, inside), "where the images overlap, and nowhere else"
    nearer = [0.9 * d for d in depths[1:2]]
    assert not shown_by(depths[0], first, views[[1]], nearer).any(), "something stands before the wall"
    about = torch.diag(torch.tensor([-1.0, 1, -1, 1], dtype=torch.float64))
    away = Cameras(first.intrinsics, first.world_from_camera @ about, first.size)
    assert not shown_by(depths[0], first, away, depths[:1]).any(), "it looks the other way"
    two = shown_by(depths[0], first, views[[1, 0]], [depths[1], depths[0]])
    assert torch.equal(two, 1 + both.long())
    for nowhere in (math.inf, math.nan, -1.0, 0.0, 1e300):
        assert not shown_by(torch.full_like(depths[0], nowhere), first, views[[1]], depths[1:2]).any(), nowhere
        assert not shown_by(depths[0], first, views[[1]], [torch.full_like(depths[1], nowhere)]).any(), nowhere


@pytest.mark.parametrize(("scale", "high"), [(1.0, math.inf), (3.0, math.inf), (3.0, 2.0), (3.0, -30.0)])
def test_the_unconditional_half_is_not_computed_where_guidance_is_off(scale: float, high: float) -> None:
    model = random_model()
    batches: list[int] = []
    model.unet.register_forward_hook(lambda _module, given, _out: batches.append(given[0].shape[0]))
    noise = torch.randn(1, 5, 8, 8, 8, generator=torch.Generator().manual_seed(0))
    config = SamplerConfig(steps=6, guidance=GuidanceConfig(scale, high_log_snr=high))
    sample(model, torch.zeros(1, 3, 8, 8, 8), torch.zeros(1, 8, 4, 4), noise, config)
    assert len(batches) == 6
    assert sum(batches) == evaluations(config, Schedule(model.config.schedule, 5))
    levels = Schedule(model.config.schedule, 5).nodes("log_snr", 6)
    guided = levels <= high if scale != 1 else levels > math.inf
    assert batches == [2 if on else 1 for on in guided.tolist()]
