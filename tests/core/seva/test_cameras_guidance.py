"""One scale for a scene, rays, and guidance by views: the original's numbers and plain loops."""

from __future__ import annotations

import pytest
import torch
from safetensors.torch import load_file

from cat3d_core.cameras import Cameras
from cat3d_core.normalization import Similarity
from cat3d_core.seva.cameras import rays, scene_middle, scene_scale
from cat3d_core.seva.guidance import ViewGuidance, rotation_degrees
from tests.core.seva.models import normalised_cameras, ring


@pytest.fixture(scope="module")
def numbers(shared_fixtures):
    return load_file(shared_fixtures / "seva_sampling.safetensors")


def test_scaled_cameras_are_exactly_the_originals(numbers):
    """Shift and scale to the last bit; with both in one similarity to float32 rounding."""
    f = numbers
    everyone, window = f["cam.all_c2w"][:, :3, 3], f["cam.c2w_opencv"][:, :3, 3]
    shifted = window - scene_middle(everyone)
    expected = f["cam.c2w_scaled"]
    assert torch.equal(shifted * (2 / shifted[0].norm()), expected[:, :3, 3])
    scene = normalised_cameras(f["cam.all_c2w"], f["cam.K_normalised"][:1].expand(8, 3, 3))
    placed = scene_scale(scene).cameras(normalised_cameras(f["cam.c2w_opencv"], f["cam.K_normalised"]))
    torch.testing.assert_close(placed.world_from_camera, expected, rtol=0, atol=3e-7)


def test_rays_agree_with_the_original(numbers):
    for name, k in (("cam", numbers["cam.K_normalised"]), ("cam1", numbers["cam.K_normalised"][:1])):
        got = rays(normalised_cameras(numbers[f"{name}.c2w_scaled"], k), 16, 24)
        torch.testing.assert_close(got, numbers[f"{name}.plucker"], rtol=0, atol=1e-6)


def test_distances_and_guidance_agree_with_the_original(numbers):
    f = numbers
    cameras = normalised_cameras(f["cam.c2w_opencv"], f["cam.K_normalised"])
    torch.testing.assert_close(rotation_degrees(cameras, cameras), f["dist.rotation_deg"], rtol=0, atol=1e-4)
    cameras = normalised_cameras(f["guide.c2w"], f["guide.K"])
    without, with_ = f["guide.pred"].chunk(2)
    for guider, name in (
        ("uniform", "guide.vanilla_s3"),
        ("multiview", "guide.multiview_s3_min1.2"),
        ("temporal", "guide.temporal_s3_min1.2"),
    ):
        scales = ViewGuidance(guider, 3.0, 1.2).scales(cameras, f["guide.input_mask"])
        if guider != "uniform":
            assert torch.equal(scales, f[f"{name}.scale"])
        guided = without + scales[:, None, None, None] * (with_ - without)
        torch.testing.assert_close(guided, f[name], rtol=1e-3, atol=1e-5)


def test_temporal_guidance_of_nine_views_agrees_with_the_original(numbers):
    given = numbers["guide9.input_mask"]
    scales = ViewGuidance("temporal", 3.0, 1.2).scales(ring(9), given)
    torch.testing.assert_close(scales, numbers["guide9.scale_s3_min1.2"], rtol=0, atol=1e-6)


def test_scale_is_one_for_the_scene_and_follows_similarities():
    cameras = ring(12)
    placed = scene_scale(cameras, reference=3).cameras(cameras)
    assert float(placed.centers[3].norm()) == pytest.approx(2)
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(0)).double())[0]
    turn = turn * torch.linalg.det(turn)
    moved = Similarity(7.5, turn, torch.tensor([3.0, -200, 10]).double()).cameras(cameras)
    again = scene_scale(moved, reference=3).cameras(moved)
    torch.testing.assert_close(rays(again, 8, 12), rays(placed, 8, 12), rtol=0, atol=1e-9)


def test_scale_leaves_outliers_out_and_stands_coincident_cameras():
    cameras = ring(60)
    far = Cameras.cat([cameras, cameras[:1]])
    far.world_from_camera[-1, :3, 3] = 1e5
    assert scene_scale(far).scale == pytest.approx(scene_scale(cameras).scale, rel=1e-9)
    same = cameras[[0, 0, 0]]
    assert scene_scale(same).scale == 2.0
    assert scene_scale(cameras[:1]).scale == 2.0
    with pytest.raises(ValueError, match="without cameras"):
        scene_scale(cameras[:0])


def test_rays_are_points_of_the_lines_of_sight():
    """Each pixel centre, moved along its ray and projected into its own camera, comes back to itself."""
    cameras = ring(5)
    height, width = 8, 12
    direction, moment = rays(cameras, height, width).flatten(2).split(3, dim=1)
    nearest = torch.linalg.cross(direction, moment, dim=1)  # the line's point nearest to the first camera
    points = (nearest + 5 * direction).mT.reshape(-1, 3)
    first = cameras.world_from_camera[0]
    world = points @ first[:3, :3].T + first[:3, 3]
    pixels, _ = cameras.resize(width, height).project(world)
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    expected = torch.stack([x, y], -1).reshape(-1, 2).double()
    for view in range(5):
        own = pixels[view].reshape(5, height * width, 2)[view]
        torch.testing.assert_close(own, expected, rtol=0, atol=1e-9)
    assert float(moment[0].abs().max()) == 0


def test_guidance_is_what_loops_say():
    cameras = ring(7)
    cameras.world_from_camera[4] = cameras.world_from_camera[0]
    cameras.world_from_camera[5, :3, 3] = cameras.centers[0]  # at a given place, turned away
    cameras.world_from_camera[6] = cameras.world_from_camera[0]
    cameras.intrinsics[6, 0, 0] *= 2
    given = torch.tensor([True, False, False, True, False, False, False])
    guidance = ViewGuidance("temporal", 4.0, 1.5)
    order = [min(abs(i - j) for j in (0, 3)) for i in range(7)]
    expected = []
    for i in range(7):
        known = [0, 3]
        turned = min(float(rotation_degrees(cameras[i], cameras[j])) for j in known) < 10
        placed = min(float((cameras.centers[i] - cameras.centers[j]).norm()) for j in known) < 1e-5
        focused = any(torch.equal(cameras.intrinsics[i], cameras.intrinsics[j]) for j in known)
        expected.append(1.5 if turned and placed and focused else 1.5 + 2.5 * order[i] / max(order))
    torch.testing.assert_close(guidance.scales(cameras, given), torch.tensor(expected), rtol=0, atol=1e-6)
    assert expected[4] == 1.5
    assert expected[5] > 1.5
    assert expected[6] > 1.5


def test_guidance_without_given_views_or_of_no_kind_is_refused():
    with pytest.raises(ValueError, match="at least one given view"):
        ViewGuidance().scales(ring(2), torch.zeros(2, dtype=torch.bool))
    with pytest.raises(ValueError, match="no guider"):
        ViewGuidance("1").scales(ring(2), torch.ones(2, dtype=torch.bool))
