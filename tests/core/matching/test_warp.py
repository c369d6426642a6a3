"""The warp against the cameras' own projection in float64, and bilinear reading against the formula."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from cat3d_core.cameras import Cameras
from cat3d_core.matching.warp import pair_maps, pixel_grid, project, take, views
from cat3d_core.metrics.psnr import psnr
from cat3d_core.rays import image_rays
from cat3d_core.synthetic.held_out import held_out_group
from flows.training.evaluation import warped
from tests.core.strategies import orbit, seeds

WIDTH, HEIGHT = 24, 16


def where(cameras: Cameras, depth: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Pixels (M, H * W, 2) and z-depths in all cameras of what camera 0 shows at z-depth `depth` (H, W)."""
    rays = image_rays(cameras, 0)
    return cameras.project(rays.origins + depth.reshape(-1, 1) * rays.directions)


@given(seeds, st.floats(0.05, 20.0))
def test_hypotheses_land_where_the_cameras_project_them(seed: int, size: float) -> None:
    cameras = orbit(4, seed=seed, width=WIDTH, height=HEIGHT)
    depth = size * (0.5 + torch.rand(HEIGHT, WIDTH, generator=torch.Generator().manual_seed(seed), dtype=torch.float64))
    pixels, z = where(cameras, depth)
    both = views(cameras)
    maps = pair_maps(both[[0]], both[torch.arange(4)[None]], torch.float64)
    at = project(maps, 1 / depth[None, None])
    expected = pixels / torch.tensor([WIDTH, HEIGHT]) * 2 - 1
    front = (z > 0.01 * depth.reshape(-1)) & (expected.abs() < 4).all(-1)
    found = at.grid[0, :, 0].reshape(4, -1, 2)
    torch.testing.assert_close(found[front], expected[front], rtol=0, atol=1e-10)
    torch.testing.assert_close(at.inverse_depth[0, :, 0].reshape(4, -1)[front], 1 / z[front], rtol=1e-9, atol=0)
    inside = front & (expected.abs() <= 1).all(-1)
    assert torch.equal(at.valid[0, :, 0].reshape(4, -1)[front], inside[front])


@given(seeds)
def test_single_precision_keeps_a_hundredth_of_a_pixel(seed: int) -> None:
    cameras = orbit(3, seed=seed, width=512, height=512)
    both = views(cameras)
    d = torch.rand(1, 2, 16, 16, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) * 3
    exact = project(pair_maps(both[[0]], both[torch.arange(3)[None]], torch.float64), d)
    single = project(pair_maps(both[[0]], both[torch.arange(3)[None]]), d.float())
    error = (exact.grid - single.grid).abs() * 256
    assert float(error[exact.valid].max()) < 0.01


def test_infinity_is_a_plane() -> None:
    """At inverse depth 0 only the rotation counts."""
    cameras = orbit(2, width=WIDTH, height=HEIGHT)
    moved = Cameras(cameras.intrinsics, cameras.world_from_camera.clone(), cameras.size)
    moved.world_from_camera[:, :3, 3] *= 7
    grids = []
    for some in (cameras, moved):
        both = views(some)
        grids.append(project(pair_maps(both[[0]], both[torch.tensor([[1]])]), torch.zeros(1, 1, HEIGHT, WIDTH)).grid)
    assert torch.equal(*grids)


def test_behind_a_photo_is_not_seen() -> None:
    cameras = orbit(2, width=WIDTH, height=HEIGHT)
    pose = cameras.world_from_camera.clone()
    pose[1] = pose[0]
    pose[1, :3, 3] += pose[0, :3, 2]  # a step forward: what is nearer than that lies behind
    both = views(Cameras(cameras.intrinsics, pose, cameras.size))
    maps = pair_maps(both[[0]], both[torch.tensor([[1]])])
    near, far = (project(maps, torch.full((1, 1, HEIGHT, WIDTH), 1 / d)) for d in (0.5, 1e3))
    assert not near.valid.any()
    assert torch.isfinite(near.grid).all()
    assert torch.isfinite(near.inverse_depth).all()
    assert far.valid[..., HEIGHT // 2, WIDTH // 2].all()


def test_reading_is_bilinear_between_pixel_centres() -> None:
    image = torch.rand(1, 2, 5, 7, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(take(image, pixel_grid(5, 7).permute(1, 2, 0)[None, None])[:, :, 0], image)
    x, y = 2.3, 1.8  # in pixels, corner at 0
    place = torch.tensor([x / 7 * 2 - 1, y / 5 * 2 - 1]).view(1, 1, 1, 1, 2)
    a, b = x - 0.5 - 1, y - 0.5 - 1
    top = image[0, :, 1, 1] * (1 - a) + image[0, :, 1, 2] * a
    low = image[0, :, 2, 1] * (1 - a) + image[0, :, 2, 2] * a
    torch.testing.assert_close(take(image, place)[0, :, 0, 0, 0], top * (1 - b) + low * b, rtol=0, atol=1e-6)


@pytest.mark.slow
def test_true_depth_through_the_warp_gives_the_model_cards_row() -> None:
    """The same picture as `flows/training/evaluation.py` makes with its own projection, on a scene of two families."""
    for family in ("llff", "mip360"):
        traced, cameras = held_out_group(family, 0, 64)
        card = warped(traced, cameras, 3)
        found = warped_by_sweep(traced.image, cameras, 1 / traced.depth, 3)
        truth = traced.image[3:]
        assert float(psnr(found, truth).mean()) > float(psnr(card, truth).mean()) - 0.2


def warped_by_sweep(image: torch.Tensor, cameras: Cameras, inverse_depth: torch.Tensor, given: int) -> torch.Tensor:
    """Targets by their true inverse depth (V, H, W): mean of the photos that see the place, holes as in the nearest."""
    from cat3d_core.matching.losses import SweepBatch, visible
    from cat3d_core.matching.network import closest, partners

    both = views(cameras)
    count = len(image) - given
    photos = torch.arange(given).repeat(count, 1)
    batch = SweepBatch(
        image[:given], inverse_depth[:given].float(), both[slice(0, given)], partners(both.pose[:given], 3), photos,
        both[slice(given, None)], image[given:], inverse_depth[given:].float(),
    )  # fmt: skip
    seen = visible(batch)[:, :, None].float()
    at = project(pair_maps(batch.target, batch.views[photos]), batch.truth_depth[:, None])
    colours = take(batch.image[photos.flatten()], at.grid.flatten(0, 1)).unflatten(0, photos.shape)[:, :, :, 0]
    nearest = batch.image[closest(batch.target, batch.views[photos])]
    total = seen.sum(1)
    return torch.where(total > 0, (colours * seen).sum(1) / total.clamp(min=1), nearest)
