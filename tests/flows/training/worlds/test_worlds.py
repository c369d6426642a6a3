"""Worlds: files read whole or refused, rays against closed forms, captures that are the same for the same key."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from cat3d_core.cameras import Cameras
from cat3d_core.synthetic.capture import look_at
from cat3d_core.warp import warp
from flows.errors import InputError
from flows.training.ranks import Ranks
from flows.training.sweep import render_bank
from flows.training.sweep_batches import GeometryBank
from flows.training.worlds import package as stk
from flows.training.worlds.groups import NEARER, Studio, group, view_depth, view_light
from flows.training.worlds.held_out import held_out_worlds
from flows.training.worlds.licences import Licences, table
from flows.training.worlds.light import Light, Sky, sunlit
from flows.training.worlds.placing import KINDS, free, place
from flows.training.worlds.scene import read_track, read_xml
from flows.training.worlds.shards import FIRST_FAMILY, open_track, world_shards
from flows.training.worlds.spm import read_spm, unpacked_normals
from flows.training.worlds.textures import LINEAR_FROM_SRGB, Atlas, mip_levels, read_texture
from flows.training.worlds.world import World
from schemas.sweep_training import SweepRunConfig

MINI = ("mini",)


@pytest.fixture(scope="module")
def studio(package: Path) -> Studio:
    return open_track(package, "mini")


def _camera(eye: tuple, target: tuple, size: int = 33, focal: float = 33.0) -> Cameras:
    k = torch.tensor([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]], dtype=torch.float64)
    pose = look_at(torch.tensor([eye], dtype=torch.float64), torch.tensor([target], dtype=torch.float64))
    return Cameras(k[None], pose, torch.tensor([[size, size]]))


def _light(sun: tuple = (0, 0, 1), sky: tuple = (0, 0, 0), sun_color: float = 1.0, ambient: float = 0.0) -> Light:
    faces = np.broadcast_to(np.array(sky, np.float32), (6, 1, 1, 3))
    direction = np.array(sun) / np.linalg.norm(sun)
    return Light(direction, np.full(3, sun_color), np.full(3, ambient), np.full(3, ambient), True, Sky(faces))


# Files.


def test_mesh_is_read_to_its_last_byte(tmp_path: Path, mesh_bytes) -> None:
    points = [(0.0, 1.0, 2.0), (3.0, 4.0, 5.0), (6.0, 7.0, 8.0), (0.5, 0.25, -1.0)]
    colors = [(1, 2, 3), None, (128, 5, 6), None]
    path = tmp_path / "a.spm"
    path.write_bytes(mesh_bytes(points, "rock.png", colors))
    (buffer,) = read_spm(path)
    np.testing.assert_array_equal(buffer.points, np.array(points, np.float32))
    np.testing.assert_array_equal(buffer.colors, [(1, 2, 3), (255, 255, 255), (128, 5, 6), (255, 255, 255)])
    np.testing.assert_array_equal(buffer.uv, [(0, 1), (1, 1), (1, 0), (0, 0)])
    np.testing.assert_array_equal(buffer.triangles, [(0, 3, 1), (1, 3, 2)])
    assert buffer.textures == ("rock.png", "")
    assert buffer.normals is None


def test_every_damaged_mesh_is_refused_with_its_name(tmp_path: Path, mesh_bytes) -> None:
    whole = mesh_bytes([(0.0, 0.0, 0.0)] * 4, "rock.png", [None, (1, 2, 3), None, (4, 5, 6)])
    path = tmp_path / "cut.spm"
    for length in range(len(whole)):
        path.write_bytes(whole[:length])
        with pytest.raises(InputError, match="cut.spm"):
            read_spm(path)
    for damaged in (whole + b"x", whole[:-1] + b"\x09", b"PK" + whole[2:], whole[:2] + b"\xff" + whole[3:]):
        path.write_bytes(damaged)
        with pytest.raises(InputError, match="cut.spm"):
            read_spm(path)


def test_packed_normals_are_signed_ten_bit_fields() -> None:
    packed = np.array([511, 511 << 10, 513 << 20], np.uint32)  # +x, +y, -z
    np.testing.assert_allclose(unpacked_normals(packed), [(1, 0, 0), (0, 1, 0), (0, 0, -1)], atol=1e-6)


def test_scene_places_meshes_and_notes_what_is_missing(package: Path) -> None:
    scene = read_track(stk.data_folder(package), "mini")
    assert sorted(p.model.name for p in scene.placements) == ["floor.spm"] + 4 * ["post.spm"] + ["wall.spm"]
    assert scene.missing == ["gone.spm", "../../../etc/passwd.spm"]  # a name with a path in it is nobody's
    assert len({p.thing for p in scene.placements if p.model.name == "post.spm"}) == 4
    np.testing.assert_allclose(scene.ground, [(0, z, 0) for z in range(-5, 6)])
    assert scene.sky_color == (1.0, 0.0, 0.0)


def test_turns_follow_the_order_of_the_format(package: Path, tmp_path: Path) -> None:
    """Scale, then about x, y, z (file axes), then the shift: worked out by hand for (1, 0, 0)."""
    scene = tmp_path / stk.DATA / "tracks" / "turned"
    scene.mkdir(parents=True)
    (scene / "a.spm").write_bytes((package / stk.DATA / "tracks/mini/floor.spm").read_bytes())
    (scene / "scene.xml").write_text(
        '<scene><static-object model="a.spm" xyz="10 20 30" hpr="0 0 90" scale="2 1 1"/>'
        '<static-object model="a.spm" hpr="0 90 0"/></scene>'
    )
    first, second = (p.matrix @ [1, 0, 0, 1] for p in read_track(tmp_path / stk.DATA, "turned").placements)
    np.testing.assert_allclose(first, [10, 30, 22, 1], atol=1e-12)  # file (0, 2, 0) + (10, 20, 30), axes exchanged
    np.testing.assert_allclose(second, [0, -1, 0, 1], atol=1e-12)  # file (0, 0, -1)


@pytest.mark.parametrize(
    "text", ["<scene>", '<!DOCTYPE a [<!ENTITY b "c">]><scene/>', "<scene><track model='f' xyz='1 2'/></scene>"]
)
def test_damaged_scenes_are_refused(tmp_path: Path, text: str) -> None:
    folder = tmp_path / "tracks" / "bad"
    folder.mkdir(parents=True)
    (folder / "f").write_text("")
    (folder / "scene.xml").write_text(text.replace("'f'", "'f.spm'"))
    (folder / "f.spm").write_text("")
    with pytest.raises(InputError, match="bad"):
        read_track(tmp_path, "bad")


def test_a_folder_without_the_package_is_refused_with_the_command(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cat3d worlds"):
        stk.data_folder(tmp_path)
    with pytest.raises(InputError, match="scene.xml"):
        read_xml(tmp_path / "scene.xml")
    (tmp_path / "no.png").write_text("no image")
    with pytest.raises(InputError, match="no.png"):
        read_texture(tmp_path / "no.png")


# Textures.


def test_bilinear_samples_and_mip_means() -> None:
    image = np.zeros((2, 4, 4), np.uint8)
    image[..., 3], image[0, 0, :3], image[1, 3, :3] = 255, 255, 255
    atlas = Atlas.of([image], [False])
    zero = np.zeros(1, int)
    centre = atlas.sample(zero, np.array([[0.125, 0.25]]), zero)
    np.testing.assert_allclose(centre, 1, atol=1e-6)
    halfway = atlas.sample(zero, np.array([[0.25, 0.25]]), zero)
    np.testing.assert_allclose(halfway, 0.5, atol=1e-6)
    # Repeated: over the left edge lies the right column.
    np.testing.assert_allclose(atlas.sample(zero, np.array([[0.0, 0.75]]), zero), 0.5, atol=1e-6)
    # The last level is the mean of linear light, to the rounding of its byte.
    np.testing.assert_allclose(atlas.sample(zero, np.array([[0.3, 0.9]]), zero + 9), 2 / 8, atol=5e-3)
    assert [level.shape[:2] for level in mip_levels(image)] == [(2, 4), (1, 2), (1, 1)]


def test_cut_away_texels_do_not_bleed_into_leaves() -> None:
    image = np.zeros((2, 2, 4), np.uint8)
    image[:, 0] = (200, 0, 0, 255)  # a leaf beside black nothing
    last = mip_levels(image)[-1][0, 0]
    assert abs(int(last[0]) - 200) <= 1
    assert last[3] == 128


def test_sky_box_faces_meet_at_their_edges(tmp_path: Path) -> None:
    """A box painted with a smooth function of direction gives that function back, wherever faces meet."""
    side, faces = 64, []
    centre = (np.arange(side) + 0.5) / side * 2 - 1
    s, t = np.meshgrid(centre, centre)
    one = np.ones_like(s)
    # top, bottom, east, west, south, north, written out from the picture's point of view
    for direction in ((t, -s, one), (-t, -s, -one), (one, -s, -t), (-one, s, -t), (-s, -one, -t), (s, one, -t)):
        d = np.stack(direction, -1)
        faces.append(d / np.linalg.norm(d, axis=-1, keepdims=True) / 2 + 0.5)
    directions = np.random.default_rng(0).normal(size=(2000, 3))
    expected = directions / np.linalg.norm(directions, axis=-1, keepdims=True) / 2 + 0.5
    np.testing.assert_allclose(Sky(np.array(faces, np.float32))(directions), expected, atol=0.02)


# Rays.


def test_depth_of_a_plane_is_exact(studio: Studio) -> None:
    """Straight down from 7 m the floor has z-depth 7 everywhere; ahead, the wall's is 10 less the camera's place."""
    down = view_depth(studio.world, _camera((20.0, 20.0, 7.0), (20.0, 20.001, 0.0)), 0)
    np.testing.assert_allclose(down.numpy(), 7, rtol=2e-3)
    ahead = view_depth(studio.world, _camera((0.0, 4.0, 2.0), (0.0, 10.0, 2.0), focal=60), 0)
    assert ahead[16, 20:25].numpy() == pytest.approx(6, rel=1e-5)


def test_leaves_stop_rays_where_they_are_opaque_only(package: Path) -> None:
    data = stk.data_folder(package)
    scene = read_track(data, "mini")
    leaves = scene.placements[[p.model.name for p in scene.placements].index("wall.spm")]
    scene.placements.append(type(leaves)(leaves.model.with_name("leaves.spm"), leaves.matrix, 99))
    depth = view_depth(World(scene, data), _camera((0.0, 4.0, 2.0), (0.0, 10.0, 2.0), focal=60), 0)
    # Leaves hang one metre before the wall; the left half of their picture is cut away.
    assert depth[16, 8].item() == pytest.approx(6, rel=1e-4)
    assert depth[16, 24].item() == pytest.approx(5, rel=1e-4)


def test_pictures_hang_upright_and_are_not_mirrored(studio: Studio) -> None:
    """Red is the picture's upper left corner, green the upper right, blue the lower left."""
    light = _light(sun_color=0, ambient=1)
    seen = view_light(studio.world, _camera((0.0, 0.0, 2.0), (0.0, 10.0, 2.0), focal=60), 0, light)
    grey = {"upper left": seen[12, 8], "upper right": seen[12, 24], "lower left": seen[20, 8]}
    np.testing.assert_allclose(grey["upper left"], (1, 0, 0), atol=0.02)
    np.testing.assert_allclose(grey["upper right"], (0, 1, 0), atol=0.02)
    np.testing.assert_allclose(grey["lower left"], (0, 0, 1), atol=0.02)


def test_lambert_shading_and_the_shadow_of_a_post(studio: Studio) -> None:
    """A post 2 m high at (8, 3) under a sun at 45 degrees from the south darkens 2 m of floor behind it."""
    sun = np.array([0, -1, 1]) / np.sqrt(2)
    spots = np.array([(8, 3.5 + d, 0) for d in (0.2, 1.0, 1.9, 2.2, 4.0)])
    up = np.broadcast_to([0.0, 0.0, 1.0], spots.shape)
    assert sunlit(studio.world, spots, up, sun).tolist() == [False, False, False, True, True]
    seen = view_light(studio.world, _camera((20.0, 20.0, 7.0), (20.0, 20.001, 0.0)), 0, _light(sun=(0, -1, 1)))
    grey = LINEAR_FROM_SRGB[128]  # a mesh without texture
    np.testing.assert_allclose(seen, grey / np.sqrt(2), rtol=1e-3)


def test_the_sky_is_at_infinity_and_has_its_colour(studio: Studio) -> None:
    camera = _camera((0.0, 0.0, 2.0), (0.0, 1.0, 40.0))
    assert view_depth(studio.world, camera, 0).isinf().all()
    np.testing.assert_allclose(
        view_light(studio.world, camera, 0, _light(sky=(0.2, 0.3, 0.4)))[3, 3], (0.2, 0.3, 0.4), rtol=1e-5
    )
    np.testing.assert_allclose(studio.sky(np.array([[0.1, 0.2, 0.9]])), [(1, 0, 0)], atol=1e-6)


def test_free_places(studio: Studio) -> None:
    """In the open; inside a post; a hand's breadth before the wall; below the floor."""
    places = np.array([(0, 0, 1.5), (8, 3, 1.0), (0, 9.9, 2.0), (0, 0, -1.0)])
    assert free(studio.world, places).tolist() == [True, False, False, False]


# Captures.


@pytest.mark.parametrize("kind", KINDS)
def test_cameras_of_each_kind_stand_free(studio: Studio, kind: str) -> None:
    random = np.random.default_rng(3)
    found = [p for p in (place(studio.world, kind, random, 6) for _ in range(60)) if p is not None]
    assert found
    for eyes, targets in found[:3]:
        assert eyes.shape == targets.shape == (6, 3)
        assert free(studio.world, eyes).all()


def test_groups_follow_from_their_key_and_depth_reprojects(studio: Studio) -> None:
    first, again = (_first_group(studio, 0) for _ in range(2))
    assert torch.equal(first.image, again.image)
    assert torch.equal(first.inverse_depth, again.inverse_depth)
    assert not torch.equal(first.image, _first_group(studio, 5).image)
    assert float(first.inverse_depth.flatten().quantile(0.99)) < 1.1 * NEARER
    assert first.image.shape == (6, 3, 48, 48)
    assert first.image.dtype == torch.uint8
    # Unit distance, +z up: the cameras look at the origin from a distance of about one.
    distance = first.cameras.centers.norm(dim=-1)
    assert 0.3 < float(distance.mean()) < 3
    image, depth = first.image.float() / 255, 1 / first.inverse_depth
    carried, seen = warp([image[0]], [depth[0]], first.cameras[:1], first.cameras[1], depth[1])
    assert seen.float().mean() > 0.2
    error = (carried - image[1]).abs().mean(0)[seen]
    assert float(error.median()) < 0.03


def _first_group(studio: Studio, first: int):
    for number in range(first, first + 20):
        try:
            return group(studio, number, 6, 48, 7)
        except ValueError:
            continue
    raise AssertionError("the miniature has no room")


def test_shards_are_resumed_and_read_back_as_held_out_worlds(package: Path, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("flows.training.worlds.shards.SHARD_GROUPS", 2)
    steps: list[int] = []
    world_shards(tmp_path, package, MINI, [0, 1], 5, 32, 0, steps.append, first=3)
    paths = sorted((tmp_path / "renders").iterdir())
    assert [p.name for p in paths] == ["00003.safetensors", "00004.safetensors"]
    assert steps == [2, 2]
    shard = load_file(paths[0])
    assert shard["image"].shape == (2, 5, 3, 32, 32)
    assert shard["inverse_depth"].dtype == torch.float16
    assert ((shard["family"] >= FIRST_FAMILY) & (shard["family"] < FIRST_FAMILY + len(KINDS))).all()
    before = [p.stat().st_mtime_ns for p in paths]
    world_shards(tmp_path, package, MINI, [0, 1], 5, 32, 0, steps.append, first=3)
    assert [p.stat().st_mtime_ns for p in paths] == before
    worlds = list(held_out_worlds(tmp_path, views=4))
    assert len(worlds) == 4
    assert worlds[0].image.shape == (4, 3, 32, 32)
    assert worlds[0].depth.shape == (4, 32, 32)
    with pytest.raises(InputError, match="5 views"):
        next(held_out_worlds(tmp_path, views=9))
    with pytest.raises(InputError, match="cat3d worlds"):
        next(held_out_worlds(tmp_path / "none"))


def test_a_plane_sweep_draws_worlds_as_often_as_procedural_scenes(
    package: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("flows.training.worlds.shards.SHARD_GROUPS", 2)
    monkeypatch.setattr("flows.training.sweep.TRAINING", MINI)
    bank = {"families": ["llff"], "scenes": 2, "views": 4, "size": 32, "worlds": str(package), "world_groups": 4}
    stages = [{"size": 32, "share": 1}]
    config = SweepRunConfig.model_validate({"bank": bank, "stages": stages, "photos": [1], "steps": 1})
    render_bank(config, tmp_path, Ranks(0, 1, torch.device("cpu")))
    found = GeometryBank([tmp_path, tmp_path / "worlds"], held=1)
    assert found.named() == [tmp_path.name, "worlds"]
    assert [len(shards) for shards in found.sources(validation=True)] == [1, 1]
    assert len(found.sources()) == 1  # the procedural scenes are all in the shard that is held
    assert found.draw(torch.Generator().manual_seed(0))["image"].shape == (4, 3, 32, 32)


def test_no_held_out_track_is_trained_on() -> None:
    assert len(set(stk.HELD_OUT)) == 6
    assert not set(stk.HELD_OUT) & set(stk.TRAINING)


def test_licences_are_looked_up_and_unfree_files_left_out(package: Path) -> None:
    path = stk.copyright_file(package)
    licences = Licences(path)
    assert licences.of("data/textures/picture.png").name == "CC-BY-SA-3.0"
    assert licences.of("data/tracks/mini/floor.spm").name == "GPL-3+"
    assert "| CC-BY-SA-3.0 | 1 | Ann Painter |" in table(licences, ["data/textures/picture.png"])
    text = path.read_text()
    try:
        path.write_text(text.replace("CC-BY-SA-3.0", "CC-BY-NC-3.0"))
        used = [p.name for p in open_track(package, "mini").world.files]
    finally:
        path.write_text(text)
    assert "picture.png" not in used
    assert "wall.spm" in used


def test_real_package() -> None:
    """A held-out track of the package itself, where CAT3D_WORLDS names the folder it was unpacked into."""
    folder = os.environ.get("CAT3D_WORLDS")
    if not folder:
        pytest.skip("CAT3D_WORLDS does not name a folder with supertuxkart-data; 'cat3d worlds FOLDER' fetches it.")
    data = stk.data_folder(Path(folder))
    for name in (*stk.TRAINING, *stk.HELD_OUT):
        assert (data / "tracks" / name / "scene.xml").is_file()
    studio = open_track(Path(folder), "snowtuxpeak")
    assert len(studio.world.triangles) > 10_000
    assert len(studio.world.ground) > 50
    assert studio.world.things
    one = _first_group(studio, 0)
    assert float(one.image.float().std()) > 15
    assert (one.inverse_depth > 0).float().mean() > 0.4
