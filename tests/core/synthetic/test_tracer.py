"""The tracer: depth and normals in closed form, agreement between views, batches, textures."""

import math
from dataclasses import replace

import pytest
import torch

from cat3d_core.cameras import Cameras
from cat3d_core.rays import image_rays
from cat3d_core.synthetic import FAMILIES, Scene, look_at, random_cameras, random_scene, render_views, trace
from cat3d_core.synthetic.builder import SceneBuilder
from cat3d_core.synthetic.textures import PATTERNS, procedural_texture, sample_pyramid, texture_pyramid


def one_object(kind: str, half: tuple[float, float, float], yaw: float = 0.0) -> Scene:
    builder = SceneBuilder("dtu", 0, None, 32)
    builder.add(kind, (0.1, -0.2, 0.3), half, yaw)
    return builder.finish((0.1, -0.2, 0.3), 2.0, (0.3, 0.2, 1.0, 0.0), False, 1e6)


def camera(position, target, size: int = 32, fov: float = 0.8) -> Cameras:
    focal = 0.5 * size / math.tan(fov / 2)
    k = torch.tensor([[[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]]], dtype=torch.float64)
    pose = look_at(torch.tensor([position], dtype=torch.float64), torch.tensor([target], dtype=torch.float64))
    return Cameras(k, pose, torch.tensor([[size, size]]))


def test_depth_and_normal_of_a_sphere():
    radius, centre = 0.5, torch.tensor([0.1, -0.2, 0.3], dtype=torch.float64)
    cam = camera((2.0, 0.4, 0.9), (0.1, -0.2, 0.3))
    out = trace(one_object("sphere", (radius,) * 3), cam)
    rays = image_rays(cam, 0)
    o, d = rays.origins - centre, rays.directions
    a, b, c = (d * d).sum(-1), (o * d).sum(-1), (o * o).sum(-1) - radius**2
    disc = b * b - a * c
    depth = torch.where(disc > 0, (-b - disc.clamp(min=0).sqrt()) / a, torch.inf).reshape(32, 32)
    clear = disc.reshape(32, 32).abs() > 1e-4  # not at the very edge
    got = out.depth[0].double()
    assert (depth.isfinite() == got.isfinite())[clear].all()
    both = depth.isfinite() & clear
    torch.testing.assert_close(got[both], depth[both], rtol=1e-5, atol=1e-4)
    normal = ((rays.origins + depth.reshape(-1, 1) * d - centre) / radius).T.reshape(3, 32, 32)
    torch.testing.assert_close(out.normal[0].double()[:, both], normal[:, both], rtol=0, atol=2e-3)
    assert (out.normal[0][:, ~got.isfinite()] == 0).all()


def test_depth_of_a_turned_box_face():
    """A box turned by 30 degrees, seen along its face's normal: constant depth, constant normal."""
    yaw = math.pi / 6
    along = (math.cos(yaw), math.sin(yaw), 0.0)
    start = tuple(c + 2 * a for c, a in zip((0.1, -0.2, 0.3), along, strict=True))
    out = trace(one_object("box", (0.4, 0.5, 0.6), yaw), camera(start, (0.1, -0.2, 0.3), fov=0.3))
    torch.testing.assert_close(out.depth, torch.full_like(out.depth, 1.6), rtol=1e-5, atol=1e-5)
    expected = torch.tensor(along)[None, :, None, None].expand_as(out.normal)
    torch.testing.assert_close(out.normal, expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize("family", FAMILIES)
def test_views_agree_through_depth(family):
    """A pixel carried by its depth into another view, where it is visible, has the same colour and normal there."""
    scene = random_scene(family, 5)
    haze_free = torch.full_like(scene.haze_distance, 1e9)
    matte = replace(scene, gloss=torch.zeros_like(scene.gloss), haze_distance=haze_free)
    cameras = random_cameras(scene, 1, 2, 96, 96, spread=0.15)
    out = trace(matte, cameras, supersample=3)
    rays = image_rays(cameras, 0)
    depth = out.depth[0].reshape(-1).double()
    solid = depth.isfinite()
    points = (rays.origins + depth[:, None] * rays.directions)[solid]
    pixels, z = cameras[1].project(points)
    grid = (pixels / 96 * 2 - 1)[:, :, None].float()
    inside = (grid.abs() < 0.97).all(-1)[0, :, 0] & (z[0] > 0)
    look = torch.nn.functional.grid_sample
    there = torch.nan_to_num(out.depth[1:, None], posinf=1e6)
    seen_depth = look(there, grid, mode="nearest", align_corners=False)[0, 0, :, 0]
    visible = inside & ((seen_depth - z[0]).abs() < 0.02 * z[0])
    assert visible.double().mean() > 0.3
    colour_here = out.image[0].reshape(3, -1)[:, solid][:, visible]
    colour_there = look(out.image[1:], grid, align_corners=False)[0, :, :, 0][:, visible]
    error = (colour_here - colour_there).abs().mean(0)
    assert error.median() < 0.02
    assert (error < 0.1).double().mean() > 0.9
    normal_here = out.normal[0].reshape(3, -1)[:, solid][:, visible]
    normal_there = look(out.normal[1:], grid, mode="nearest", align_corners=False)[0, :, :, 0][:, visible]
    assert ((normal_here * normal_there).sum(0) > 0.98).double().mean() > 0.9


def test_a_batch_of_scenes_is_its_scenes():
    scenes = [random_scene(f, 3) for f in FAMILIES]
    cameras = [random_cameras(s, 0, 2, 24, 24).to(dtype=torch.float32) for s in scenes]
    together = render_views(Scene.stack(scenes), Cameras.cat(cameras))
    for i, (scene, own) in enumerate(zip(scenes, cameras, strict=True)):
        alone = render_views(scene, own)[0]
        # The order of sums may differ in the last bits; a ray at an edge may then fall on the other side.
        assert ((together[i] - alone).abs() < 1e-3).float().mean() > 0.995


def test_shadow_falls_where_the_sun_is_hidden():
    builder = SceneBuilder("co3d", 0, None, 32)
    builder.add_ground()
    builder.add("box", (0.0, 0.0, 1.0), (0.3, 0.3, 0.1))
    lit = builder.finish((0.0, 0.0, 0.0), 3.0, (0.0, 0.0, 1.0, 0.0), False, 1e9)
    scene = replace(
        lit,
        tint=torch.zeros_like(lit.tint),
        bias=torch.ones_like(lit.bias),
        gloss=torch.zeros_like(lit.gloss),
        ambient=torch.full_like(lit.ambient, 0.2),
        light_colour=torch.full_like(lit.light_colour, 0.5),
    )
    down = camera((2.0, 0.01, 0.6), (0.0, 0.0, 0.0), size=64, fov=0.9)
    out = trace(scene, down, supersample=1)
    rays = image_rays(down, 0)
    points = rays.origins + out.depth[0].reshape(-1, 1).double() * rays.directions
    ground = out.normal[0, 2].reshape(-1) > 0.99
    ground &= points[:, 2].abs() < 1e-3
    shaded = points[:, :2].abs().amax(-1) < 0.28
    open_ = points[:, :2].abs().amax(-1) > 0.32
    brightness = out.image[0, 0].reshape(-1)
    assert int((ground & shaded).sum()) > 20
    assert (brightness[ground & shaded] - 0.2).abs().max() < 1e-4
    assert (brightness[ground & open_] - 0.7).abs().max() < 1e-4


def test_textures_are_colours_and_the_pyramid_keeps_their_mean():
    random = torch.Generator().manual_seed(0)
    textures = torch.stack([procedural_texture(32, random) for _ in range(3 * len(PATTERNS))])[None]
    assert ((textures >= 0) & (textures <= 1)).all()
    assert float(textures.var((3, 4)).mean()) > 1e-3
    pyramid = texture_pyramid(textures)
    which = torch.arange(textures.shape[1])
    uv = torch.rand(len(which), 2, generator=random)
    blurred = sample_pyramid(pyramid, which, uv, torch.full((len(which),), 1e9))
    torch.testing.assert_close(blurred, textures[0].mean((2, 3)), atol=5e-3, rtol=0)


def test_texture_lookup_hits_texel_centres():
    texture = torch.rand(1, 1, 3, 8, 8, generator=torch.Generator().manual_seed(0))
    pyramid = texture_pyramid(texture)
    v, u = torch.meshgrid((torch.arange(8) + 0.5) / 8, (torch.arange(8) + 0.5) / 8, indexing="ij")
    # The first of the mirrored repeats runs from 1 to 2.
    uv = torch.stack([u, v], -1) + 1
    got = sample_pyramid(pyramid, torch.zeros(8, 8, dtype=torch.long), uv, torch.zeros(8, 8))
    torch.testing.assert_close(got.permute(2, 0, 1), texture[0, 0], atol=1e-5, rtol=0)


def test_errors_are_sentences():
    scene = random_scene("dtu", 0)
    small, large = camera((2, 0, 1), (0, 0, 0), 8), camera((2, 0, 1), (0, 0, 0), 9)
    with pytest.raises(ValueError, match="one image size"):
        trace(scene, Cameras.cat([small, large]))
    with pytest.raises(ValueError, match="holds 2"):
        trace(Scene.stack([scene, scene]), small)
    with pytest.raises(ValueError, match="evenly"):
        render_views(Scene.stack([scene, scene]), small)


def test_light_of_a_matte_surface_is_its_albedo_times_the_skys_share():
    """Without a lamp and haze: (bias + tint * texture) * ambient * (0.7 + 0.3 n_z), in closed form."""
    scene = one_object("sphere", (0.5,) * 3)
    slot = int(scene.active[0].nonzero()[0, 0])
    scene.bias[0, slot], scene.tint[0, slot] = torch.tensor([0.1, 0.2, 0.3]), torch.tensor([0.4, 0.2, -0.1])
    plain = replace(
        scene, textures=torch.full_like(scene.textures, 0.5), gloss=torch.zeros_like(scene.gloss),
        haze_distance=torch.full_like(scene.haze_distance, 1e12), light_colour=torch.zeros_like(scene.light_colour),
    )  # fmt: skip
    out = trace(plain, camera((2.0, 0.4, 0.9), (0.1, -0.2, 0.3), fov=0.2), supersample=1)
    assert out.depth.isfinite().all()
    albedo = torch.tensor([0.3, 0.3, 0.25])
    expected = (albedo * scene.ambient[0])[:, None, None] * (0.7 + 0.3 * out.normal[0, 2])
    torch.testing.assert_close(out.image[0], expected, rtol=1e-4, atol=1e-5)


def test_a_disc_is_clear_of_footprints_that_it_does_not_touch():
    builder = SceneBuilder("dtu", 0, None, 32)
    builder.add("cylinder", (1.0, 2.0, 0.3), (0.3, 0.4, 0.3))  # footprint: a disc of radius 0.5
    assert builder.clear_of_others(1.0, 3.01, 0.5)
    assert not builder.clear_of_others(1.0, 2.99, 0.5)
    assert not builder.clear_of_others(0.01, 2.0, 0.5)
    assert builder.clear_of_others(-1.0, 2.0, 0.5)
