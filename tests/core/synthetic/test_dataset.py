"""Training captures: normalised cameras that explain the pictures, and variants that stay consistent."""

import pytest
import torch

from cat3d_core.rays import image_rays
from cat3d_core.synthetic import FAMILIES, random_cameras, random_scene, trace
from cat3d_core.synthetic.dataset import mirrored, recoloured, surface_points, training_capture
from cat3d_core.synthetic.held_out import held_out_group


@pytest.mark.parametrize("family", FAMILIES)
def test_captures_are_seeded_and_normalised(family):
    one, same = (training_capture(family, 11, 4, 16) for _ in range(2))
    assert torch.equal(one.image, same.image)
    assert one.image.shape == (4, 3, 16, 16)
    one.cameras.validate()
    assert 0.2 < float(one.cameras.centers.norm(dim=-1).median()) < 5


def test_mirroring_twice_is_nothing_and_once_is_rigid():
    capture = training_capture("co3d", 3, 3, 16)
    once, twice = mirrored(capture), mirrored(mirrored(capture))
    once.cameras.validate()
    torch.testing.assert_close(twice.cameras.world_from_camera, capture.cameras.world_from_camera)
    torch.testing.assert_close(twice.cameras.intrinsics, capture.cameras.intrinsics)
    assert torch.equal(twice.image, capture.image)


def test_the_mirrored_ray_of_the_mirrored_pixel_is_the_mirrored_ray():
    capture = training_capture("llff", 3, 2, 8)
    flipped = mirrored(capture)
    for view in range(2):
        here, there = image_rays(capture.cameras, view), image_rays(flipped.cameras, view)
        negate = torch.tensor([-1.0, 1, 1], dtype=torch.float64)
        own = here.directions.reshape(8, 8, 3).flip(1).reshape(-1, 3)
        torch.testing.assert_close(there.directions, own * negate)
        torch.testing.assert_close(there.origins, here.origins * negate)


def test_recolouring_permutes_channels():
    capture = training_capture("dtu", 3, 2, 8)
    out = recoloured(capture, torch.Generator().manual_seed(0)).image
    torch.testing.assert_close(out.sort(1).values, capture.image.sort(1).values)


def test_surface_points_project_onto_their_depth():
    scene = random_scene("mip360", 2)
    cameras = random_cameras(scene, 0, 3, 24, 24)
    depth = trace(scene, cameras, supersample=1).depth
    points = surface_points(depth[:1], cameras[0])
    _, z = cameras[0].project(points)
    torch.testing.assert_close(z[0], depth[0][depth[0].isfinite()].double())


def test_mirrored_depth_stays_with_its_pixels():
    capture = training_capture("llff", 3, 2, 16, with_depth=True)
    assert torch.equal(mirrored(capture).inverse_depth, capture.inverse_depth.flip(-1))


def test_depth_is_in_the_unit_of_the_normalised_cameras():
    """A place that one view sees is at the other one's depth, where both see it; the scene's own unit is another."""
    capture = training_capture("dtu", 5, 3, 32, with_depth=True)
    cameras, inverse = capture.cameras, capture.inverse_depth.double()
    pixels, z = cameras.project(surface_points(1 / capture.inverse_depth[:1], cameras[0]))
    for view in (1, 2):
        inside = (z[view] > 0) & (pixels[view] >= 0).all(-1) & (pixels[view] < 32).all(-1)
        x, y = pixels[view][inside].long().unbind(-1)
        assert float((inverse[view][y, x] * z[view][inside] - 1).abs().median()) < 0.02


def test_a_held_out_group_is_the_same_every_time():
    (one, cameras), (same, again) = (held_out_group("llff", 1, 12, 4) for _ in range(2))
    assert torch.equal(cameras.world_from_camera, again.world_from_camera)
    assert torch.equal(one.image, same.image)
