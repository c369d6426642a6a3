"""Cameras: projection, crops, pads, resizes and validation."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from cat3d_core.cameras import Cameras, orthonormalize
from cat3d_core.rays import pixel_rays
from tests.core.strategies import orbit, seeds


def test_known_point_projects_to_known_pixel() -> None:
    k = torch.tensor([[[100.0, 0, 32], [0, 50, 24], [0, 0, 1]]], dtype=torch.float64)
    camera = Cameras(k, torch.eye(4, dtype=torch.float64)[None], torch.tensor([[64, 48]]))
    pixels, depth = camera.project(torch.tensor([[0.2, -0.1, 2.0]], dtype=torch.float64))
    assert pixels[0, 0].tolist() == pytest.approx([32 + 100 * 0.1, 24 - 50 * 0.05])
    assert depth.item() == 2


@given(seeds, st.integers(1, 5))
def test_points_along_a_pixels_ray_project_back_to_it(seed: int, count: int) -> None:
    cameras = orbit(count, seed=seed)
    g = torch.Generator().manual_seed(seed)
    view = torch.randint(0, count, (7,), generator=g)
    xy = torch.rand(7, 2, generator=g, dtype=torch.float64) * torch.tensor([64.0, 48.0], dtype=torch.float64)
    rays = pixel_rays(cameras, view, xy)
    t = torch.exp(torch.randn(7, 1, generator=g, dtype=torch.float64))
    pixels, depth = cameras.project(rays.origins + t * rays.directions)
    picked = torch.arange(7)
    torch.testing.assert_close(pixels[view, picked], xy, rtol=0, atol=1e-9)
    torch.testing.assert_close(depth[view, picked], t[:, 0], rtol=1e-12, atol=1e-12)


@given(seeds, st.integers(-20, 20), st.integers(-20, 20), st.integers(1, 100), st.integers(1, 100))
def test_crop_pad_and_resize_keep_the_ray_of_a_pixel(seed: int, x0: int, y0: int, width: int, height: int) -> None:
    cameras = orbit(2, seed=seed)
    g = torch.Generator().manual_seed(seed)
    xy = torch.rand(5, 2, generator=g, dtype=torch.float64) * 40
    view = torch.tensor([0, 1, 0, 1, 0])
    expected = pixel_rays(cameras, view, xy).directions
    offset = torch.tensor([x0, y0], dtype=torch.float64)
    factors = torch.tensor([width / 64, height / 48], dtype=torch.float64)
    cases = {
        "crop": (cameras.crop(x0, y0, width, height), xy - offset),
        "pad": (cameras.pad(abs(x0), abs(y0), 3, 4), xy + offset.abs()),
        "resize": (cameras.resize(width, height), xy * factors),
    }
    for name, (changed, moved) in cases.items():
        torch.testing.assert_close(pixel_rays(changed, view, moved).directions, expected, rtol=0, atol=1e-9, msg=name)
    assert cameras.pad(1, 2, 3, 4).size[0].tolist() == [64 + 4, 48 + 6]
    assert cameras.resize(width, height).size[1].tolist() == [width, height]


def test_ray_through_the_principal_point_is_the_optical_axis() -> None:
    cameras = orbit(3)
    principal = cameras.intrinsics[:, :2, 2]
    rays = pixel_rays(cameras, torch.arange(3), principal)
    torch.testing.assert_close(rays.directions, cameras.forward)
    assert float((rays.directions.norm(dim=-1) - 1).abs().max()) < 1e-12


def test_projection_behind_the_camera_is_finite() -> None:
    pixels, depth = orbit(2).project(torch.tensor([[100.0, 100, 100], [0, 0, 0]], dtype=torch.float64))
    assert torch.isfinite(pixels).all()
    assert torch.isfinite(depth).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c.world_from_camera.__setitem__((1, 0, 3), math.nan), "view b has a NaN"),
        (lambda c: c.intrinsics.__setitem__((1, 0, 2), math.inf), "NaN or infinite number in its intrinsics"),
        (lambda c: c.intrinsics.__setitem__((1, 0, 0), 0.0), "focal length of 0 x"),
        (lambda c: c.size.__setitem__((1, 0), 0), "image size of 0 x 48"),
        (lambda c: c.world_from_camera[1, :3, :3].mul_(2), "not a rotation"),
        (lambda c: c.world_from_camera[1, :3, 0].mul_(-1), "mirrored"),
        (lambda c: c.world_from_camera.__setitem__((1, 3, 0), 1.0), "last row"),
    ],
)
def test_validate_names_the_view_and_the_fault(change, message: str) -> None:
    cameras = orbit(3)
    cameras.validate(["a", "b", "c"])
    change(cameras)
    with pytest.raises(ValueError, match=message):
        cameras.validate(["a", "b", "c"])


def test_wrong_shapes_are_refused() -> None:
    with pytest.raises(ValueError, match=r"intrinsics has shape \(2, 3, 4\)"):
        Cameras(torch.zeros(2, 3, 4), torch.zeros(2, 4, 4), torch.zeros(2, 2))
    with pytest.raises(ValueError, match="empty"):
        orbit(1).crop(0, 0, 0, 4)
    with pytest.raises(ValueError, match="both sides must be positive"):
        orbit(1).resize(3, 0)


@given(seeds)
def test_orthonormalize_repairs_rounding_and_keeps_rotations(seed: int) -> None:
    cameras = orbit(3, seed=seed)
    rounded = (cameras.world_from_camera * 1e4).round() / 1e4
    repaired = orthonormalize(rounded)
    identity = repaired[:, :3, :3] @ repaired[:, :3, :3].transpose(1, 2)
    torch.testing.assert_close(identity, torch.eye(3, dtype=torch.float64).expand(3, 3, 3), rtol=0, atol=1e-12)
    torch.testing.assert_close(repaired[:, :3, :3], cameras.rotation, rtol=0, atol=2e-4)
