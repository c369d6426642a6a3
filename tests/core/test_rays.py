"""Rays, cone radii and raymaps."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from cat3d_core.rays import image_rays, pixel_rays, raymap
from tests.core.strategies import orbit, random_similarity, seeds


@given(seeds, st.booleans())
def test_raymap_ignores_rigid_motions_of_the_world(seed: int, plucker: bool) -> None:
    cameras = orbit(4, seed=seed)
    moved = random_similarity(seed, scaled=False).cameras(cameras)
    here = raymap(cameras, cameras.world_from_camera[0], 6, 8, plucker)
    there = raymap(moved, moved.world_from_camera[0], 6, 8, plucker)
    torch.testing.assert_close(there, here, rtol=0, atol=1e-9)


@given(seeds, st.floats(0.01, 100))
def test_scaling_the_world_scales_origins_only(seed: int, scale: float) -> None:
    cameras = orbit(3, seed=seed)
    pose = cameras.world_from_camera.clone()
    pose[:, :3, 3] *= scale
    scaled = type(cameras)(cameras.intrinsics, pose, cameras.size)
    here = raymap(cameras, cameras.world_from_camera[0], 4, 4)
    there = raymap(scaled, pose[0], 4, 4)
    torch.testing.assert_close(there[:, :3], here[:, :3] * scale, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(there[:, 3:], here[:, 3:], rtol=0, atol=1e-12)


def test_raymap_cells_are_the_rays_of_their_centres() -> None:
    cameras = orbit(2, width=64, height=48)
    maps = raymap(cameras, torch.eye(4, dtype=torch.float64), 6, 8)  # 8 x 8 pixel cells
    rays = pixel_rays(cameras, torch.tensor([1]), torch.tensor([[3 * 8 + 4.0, 2 * 8 + 4.0]], dtype=torch.float64))
    torch.testing.assert_close(maps[1, :3, 2, 3], rays.origins[0])
    torch.testing.assert_close(maps[1, 3:, 2, 3], torch.nn.functional.normalize(rays.directions[0], dim=0))


def test_first_camera_is_the_frame_of_its_own_raymap() -> None:
    cameras = orbit(3)
    first = raymap(cameras, cameras.world_from_camera[0], 5, 5)[0]
    assert float(first[:3].abs().max()) < 1e-12
    moments = raymap(cameras, cameras.world_from_camera[0], 5, 5, plucker=True)
    assert float((moments[:, :3] * moments[:, 3:]).sum(1).abs().max()) < 1e-12  # a moment is normal to its ray


def test_cone_radius_matches_ray_differences_in_float64() -> None:
    cameras = orbit(1)
    xy = torch.tensor([[10.0, 20.0]], dtype=torch.float64)
    zero = torch.zeros(1, dtype=torch.long)
    base = pixel_rays(cameras, zero, xy)
    dx = pixel_rays(cameras, zero, xy + torch.tensor([1.0, 0])).directions - base.directions
    dy = pixel_rays(cameras, zero, xy + torch.tensor([0, 1.0])).directions - base.directions
    expected = 0.5 * (dx.norm() + dy.norm()) * 2 / 12**0.5
    assert base.radii.item() == pytest.approx(expected.item(), rel=1e-12)


def test_image_rays_cover_pixel_centres_in_row_order() -> None:
    cameras = orbit(2)
    rays = image_rays(cameras, 1)
    assert rays.origins.shape == (64 * 48, 3)
    pixels, _ = cameras[1].project(rays.origins + 2 * rays.directions)
    torch.testing.assert_close(pixels[0, 64 * 5 + 7], torch.tensor([7.5, 5.5], dtype=torch.float64))
    half = image_rays(cameras, 1, 32, 24)
    assert half.origins.shape == (32 * 24, 3)
    assert half.radii[0] > rays.radii[0]


def test_float32_rays_are_close_to_float64() -> None:
    cameras = orbit(3)
    exact = raymap(cameras, cameras.world_from_camera[0], 8, 8)
    single = raymap(cameras.to(dtype=torch.float32), cameras.world_from_camera[0].float(), 8, 8)
    torch.testing.assert_close(single.double(), exact, rtol=0, atol=2e-6)
