"""Photos carried into another camera: against the ray tracer, which knows what that camera sees."""

from __future__ import annotations

import pytest
import torch

from cat3d_core.cameras import Cameras
from cat3d_core.metrics.psnr import psnr
from cat3d_core.rays import image_rays
from cat3d_core.synthetic import FAMILIES
from cat3d_core.synthetic.held_out import held_out_group
from cat3d_core.view_selection import camera_distance
from cat3d_core.warp import warp
from tests.core.seva.models import ring


def _wall(cameras: Cameras, view: int, distance: float = 5.0) -> tuple[torch.Tensor, torch.Tensor]:
    """What a camera sees of the plane z = -1 with a smooth pattern: image (3, H, W) and z-depth (H, W), float64."""
    width, height = cameras.size[view].tolist()
    rays = image_rays(cameras, view)
    depth = (-1 - rays.origins[:, 2]) / rays.directions[:, 2]
    points = rays.origins + depth[:, None] * rays.directions
    colour = 0.5 + 0.4 * torch.stack([points[:, 0].sin(), points[:, 1].cos(), (points[:, 0] + points[:, 1]).sin()], -1)
    depth = torch.where(depth > 0, depth, torch.full_like(depth, torch.inf))
    seen = depth.isfinite()[:, None]
    return torch.where(seen, colour, 0.0).T.reshape(3, height, width), depth.reshape(height, width)


def test_a_plane_is_carried_exactly_where_both_see_it():
    cameras = ring(4)
    views = [_wall(cameras, view) for view in range(4)]
    image, seen = warp(
        [views[1][0].float(), views[3][0].float()], [views[1][1].float(), views[3][1].float()], cameras[[1, 3]],
        cameras[0], views[0][1].float(),
    )  # fmt: skip
    plane = views[0][1] < 8  # beyond, the pattern is finer than the pixels
    assert float((seen & plane).double().sum() / plane.sum()) > 0.5
    assert float((image - views[0][0]).abs()[:, seen & plane].max()) < 0.05
    assert float(image[:, ~seen].abs().max()) == 0


def test_what_stands_in_front_hides_what_is_behind():
    cameras = ring(2)
    (photo, there), (_, depth) = _wall(cameras, 0), _wall(cameras, 1)
    nearer = there.clone()
    nearer[:, :48] = 0.5  # the photo shows something close in its left half
    _, open_view = warp([photo.float()], [there.float()], cameras[:1], cameras[1], depth.float())
    _, hidden = warp([photo.float()], [nearer.float()], cameras[:1], cameras[1], depth.float())
    assert 0 < int(hidden.sum()) < int(open_view.sum())
    assert not (hidden & ~open_view).any()


def test_the_first_photo_that_shows_a_place_wins():
    cameras = ring(2)[[0, 0, 0]]
    photo, depth = _wall(cameras, 0)
    image, seen = warp([photo.float(), 0 * photo.float()], [depth.float()] * 2, cameras[:2], cameras[2], depth.float())
    inside = seen & depth.isfinite()
    torch.testing.assert_close(image[:, inside], photo.float()[:, inside], rtol=0, atol=1e-5)


@pytest.mark.parametrize("family", FAMILIES)
def test_traced_scenes_are_close_where_they_are_seen(family):
    traced, cameras = held_out_group(family, 0, 64, spread=0.2)
    order = camera_distance(cameras)[7, :7].argsort().tolist()
    photos, depths = list(traced.image[order]), list(traced.depth[order])
    image, seen = warp(photos, depths, cameras[order], cameras[7], traced.depth[7])
    assert seen.float().mean() > 0.5
    assert float(psnr(image[None], traced.image[7:], seen[None].float())) > 20
