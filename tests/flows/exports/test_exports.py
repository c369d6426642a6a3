"""Exports: fusion of exact depth, files read back, a data set through our own readers, the command and its errors."""

from __future__ import annotations

import builtins
import json
import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import open3d
import pytest
import torch
import trimesh
from torch import Tensor
from typer.testing import CliRunner

from cat3d_core.cameras import Cameras
from cat3d_core.metrics.geometry import nearest_distances
from cat3d_core.normalization import Similarity
from cat3d_core.rays import image_rays
from cat3d_core.reconstruction import Render, normals_from_depth, point_cloud, surface_depth
from cat3d_core.splats import render
from cat3d_core.synthetic.capture import look_at
from cat3d_core.zipnerf import PRESETS, Field, render_ladder
from flows.bench.geometry import mesh_row, sample_surface, true_depths
from flows.bench.reconstruct import procedural_views
from flows.cli import app
from flows.commands.export import SurfaceSettings, export_command
from flows.errors import InputError
from flows.exports import mesh as meshes
from flows.exports.dataset import write_dataset
from flows.exports.path import read_path
from flows.exports.ply import write_ply
from flows.exports.source import open_source, training_images
from flows.exports.splat_files import READERS
from flows.jobs.access import read_cameras
from flows.jobs.request import make_config
from flows.media.images import read_image
from flows.open3d_import import import_open3d
from flows.pipeline.runner import opened, run_missing
from flows.readers import read_capture
from schemas.scene_store import SceneStore

CENTRE, RADIUS = torch.tensor([0.1, -0.2, 0.3], dtype=torch.float64), 0.5


def sphere_views(count: int = 20, size: int = 96) -> tuple[list[Render], Cameras]:
    """Exact renders of a sphere coloured by its normals, seen from all sides through off-centre lenses."""
    random = torch.Generator().manual_seed(0)
    outwards = torch.nn.functional.normalize(torch.randn((count, 3), generator=random, dtype=torch.float64), dim=-1)
    pose = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    pose[:, :3, :3] = look_at(CENTRE + 2 * outwards, CENTRE.expand(count, 3))[:, :3, :3]
    pose[:, :3, 3] = CENTRE + 2 * outwards
    k = torch.tensor([[1.2 * size, 0, size / 2 + 3.3], [0, 1.1 * size, size / 2 - 2.7], [0, 0, 1]], dtype=torch.float64)
    cameras = Cameras(k.expand(count, 3, 3), pose, torch.tensor([[size, size]]).expand(count, 2))
    renders = []
    for index in range(count):
        rays = image_rays(cameras, index)
        offset, direction = rays.origins - CENTRE, rays.directions
        a, b = direction.square().sum(-1), (offset * direction).sum(-1)
        root = b.square() - a * (offset.square().sum(-1) - RADIUS**2)
        hit = root > 0
        t = torch.where(hit, (-b - root.clamp_min(0).sqrt()) / a, 100.0)
        depth, colour = t.view(size, size), 0.5 + 0.5 * (offset + t[:, None] * direction) / RADIUS
        normals = normals_from_depth(depth, rays)
        renders.append(Render(colour.view(size, size, 3), depth, depth, hit.double().view(size, size), normals))
    return renders, cameras


@pytest.fixture(scope="module")
def sphere() -> meshes.Mesh:
    renders, cameras = sphere_views()
    views = ((surface_depth(r, cameras, i, min_cosine=0.2), r.image) for i, r in enumerate(renders))
    return meshes.fuse(views, cameras, voxel=0.02)


def test_fusion_of_a_sphere_gives_its_centre_radius_normals_and_colours(sphere: meshes.Mesh) -> None:
    offset = sphere.vertices - CENTRE.numpy()
    radius = np.linalg.norm(offset, axis=1)
    # A tenth of a voxel in the mean, a voxel at worst; a shift of half a pixel would break the first two.
    assert abs(radius.mean() - RADIUS) < 0.002
    assert radius.std() < 0.002
    assert abs(radius - RADIUS).max() < 0.02
    np.testing.assert_allclose((sphere.vertices.min(0) + sphere.vertices.max(0)) / 2, CENTRE.numpy(), atol=0.004)
    assert ((offset / radius[:, None]) * sphere.normals).sum(-1).mean() > 0.99
    assert abs(sphere.colours / 255 - (0.5 + 0.5 * offset / RADIUS)).mean() < 0.01
    shape = trimesh.Trimesh(sphere.vertices, sphere.faces, process=False)
    assert ((shape.triangles_center - CENTRE.numpy()) * shape.face_normals).sum(-1).min() > 0  # wound outwards
    assert shape.area == pytest.approx(4 * math.pi * RADIUS**2, rel=0.02)


def test_one_view_alone_makes_a_mesh() -> None:
    renders, cameras = sphere_views(1)
    mesh = meshes.fuse([(surface_depth(renders[0], cameras, 0), renders[0].image)], cameras, 0.02)
    assert abs(np.linalg.norm(mesh.vertices - CENTRE.numpy(), axis=1).mean() - RADIUS) < 0.002


def test_no_surface_is_an_error_with_a_remedy() -> None:
    renders, cameras = sphere_views(2, 16)
    nothing = [(torch.zeros_like(r.depth), r.image) for r in renders]
    with pytest.raises(InputError, match="no surface.*--opacity"):
        meshes.fuse(nothing, cameras, 0.02)


def test_surface_depth_leaves_out_what_is_thin_far_or_grazing() -> None:
    renders, cameras = sphere_views(1)
    depth = surface_depth(renders[0], cameras, 0)
    assert (depth > 0).sum() == (renders[0].opacity > 0).sum()
    assert depth.max() < 2.1
    assert not surface_depth(renders[0], cameras, 0, max_radius=0.01).any()
    assert 0 < (surface_depth(renders[0], cameras, 0, min_cosine=0.9) > 0).sum() < (depth > 0).sum() / 2


def test_crumbs_are_left_out(sphere: meshes.Mesh) -> None:
    crumb = np.array([[0, 1, 2]], np.int32) + len(sphere.vertices)
    double = meshes.Mesh(
        np.concatenate([sphere.vertices, np.eye(3, dtype=np.float32)]),
        np.concatenate([sphere.normals, sphere.normals[:3]]),
        np.concatenate([sphere.colours, sphere.colours[:3]]),
        np.concatenate([sphere.faces, crumb]),
    )
    clean = meshes.without_crumbs(double)
    assert len(clean.faces) == len(sphere.faces)
    np.testing.assert_array_equal(clean.vertices[clean.faces], sphere.vertices[sphere.faces])


def test_ply_reads_back_equal_in_two_other_packages(sphere: meshes.Mesh, tmp_path: Path) -> None:
    meshes.write_mesh_ply(tmp_path / "mesh.ply", sphere)
    read: Any = trimesh.load(tmp_path / "mesh.ply", process=False)
    np.testing.assert_array_equal(read.vertices, sphere.vertices)
    np.testing.assert_array_equal(read.faces, sphere.faces)
    np.testing.assert_array_equal(read.visual.vertex_colors[:, :3], sphere.colours)
    write_ply(tmp_path / "points.ply", sphere.vertices, sphere.normals, sphere.colours)
    cloud = open3d.io.read_point_cloud(tmp_path / "points.ply")
    np.testing.assert_array_equal(np.asarray(cloud.points), sphere.vertices)
    np.testing.assert_allclose(np.asarray(cloud.normals), sphere.normals, atol=1e-7)
    np.testing.assert_allclose(np.asarray(cloud.colors) * 255, sphere.colours, atol=1e-4)


def test_glb_reads_back_in_two_other_packages(sphere: meshes.Mesh, tmp_path: Path) -> None:
    meshes.write_mesh_glb(tmp_path / "mesh.glb", sphere)
    read: Any = trimesh.load(tmp_path / "mesh.glb", force="mesh", process=False)
    np.testing.assert_allclose(read.vertices, sphere.vertices, atol=1e-6)
    np.testing.assert_array_equal(read.faces, sphere.faces)
    linear = read.visual.vertex_colors[:, :3] / 255
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear.clip(1e-8) ** (1 / 2.4) - 0.055) * 255
    bright = sphere.colours > 60  # eight linear bits resolve the dark ones less finely
    np.testing.assert_allclose(encoded[bright], sphere.colours[bright], atol=3)
    assert len(open3d.io.read_triangle_mesh(tmp_path / "mesh.glb").vertices) == len(sphere.vertices)
    first = (tmp_path / "mesh.glb").read_bytes()
    meshes.write_mesh_glb(tmp_path / "mesh.glb", sphere)
    assert (tmp_path / "mesh.glb").read_bytes() == first


def test_a_mesh_in_another_frame(sphere: meshes.Mesh) -> None:
    quarter = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=torch.float64)
    moved = sphere.mapped(Similarity(3.0, quarter, torch.tensor([10.0, 20, 30], dtype=torch.float64)))
    expected = 3 * sphere.vertices.astype(np.float64) @ quarter.numpy().T + [10, 20, 30]
    np.testing.assert_allclose(moved.vertices, expected, rtol=1e-12)
    np.testing.assert_allclose(moved.normals, sphere.normals @ quarter.numpy().T, atol=1e-7)


def test_open3d_without_libusb_says_the_line_to_type(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = builtins.__import__

    def broken(name: str, *rest: object) -> object:
        if name == "open3d":
            raise OSError("libusb-1.0.so.0: cannot open shared object file: No such file or directory")
        return whole(name, *rest)  # type: ignore[arg-type]

    monkeypatch.setattr(builtins, "__import__", broken)
    with pytest.raises(InputError, match="sudo apt-get install -y libusb-1.0-0"):
        import_open3d("Meshes")


@pytest.mark.parametrize("reader", ["transforms", "colmap", "auto"])
def test_the_data_set_reads_back_with_equal_cameras(reader: str, tmp_path: Path) -> None:
    renders, cameras = sphere_views(4, 24)
    cameras = Cameras.cat([cameras[:3], cameras[3].crop(2, 4, 20, 12)])  # two lenses and sizes
    random = np.random.default_rng(0)
    images = [random.integers(0, 256, (h, w, 3), np.uint8) for w, h in cameras.size.tolist()]
    points = random.normal(size=(30, 3))
    colours = random.integers(0, 256, (30, 3), np.uint8)
    written = write_dataset(tmp_path, cameras, images, ["a.jpg", "b/c.jpg", "d", None], points, points, colours)
    assert written == ["captured_0000.png", "captured_0001.png", "captured_0002.png", "generated_0000.png"]
    capture = read_capture(tmp_path, reader)
    assert [Path(name).name for name in capture.names] == written
    assert capture.distortion is None
    assert capture.cameras is not None
    torch.testing.assert_close(capture.cameras.world_from_camera, cameras.world_from_camera, rtol=0, atol=1e-12)
    torch.testing.assert_close(capture.cameras.intrinsics, cameras.intrinsics, rtol=1e-13, atol=0)
    torch.testing.assert_close(capture.cameras.size, cameras.size)
    for path, image in zip(capture.paths, images, strict=True):
        np.testing.assert_array_equal(read_image(path)[0], image)
    if capture.points is not None:
        assert float(nearest_distances(torch.from_numpy(points), capture.points).max()) < 1e-12


def test_a_skewed_camera_cannot_be_written(tmp_path: Path) -> None:
    _, cameras = sphere_views(1, 8)
    k = cameras.intrinsics.clone()
    k[0, 0, 1] = 0.5
    none = np.zeros((0, 3))
    skewed = Cameras(k, cameras.world_from_camera, cameras.size)
    with pytest.raises(InputError, match="skewed pixels"):
        write_dataset(tmp_path, skewed, [], [None], none, none, none)


def test_camera_paths_and_what_is_wrong_with_them(tmp_path: Path) -> None:
    file = tmp_path / "path.json"
    pose = torch.eye(4).tolist()

    def path_of(document: object) -> Cameras:
        file.write_text(json.dumps(document))
        return read_path(file, 40, 30).cameras

    cameras = path_of([{"world_from_camera": pose, "fov": 90}])
    assert cameras.size.tolist() == [[40, 30]]
    top, depth = cameras.project(torch.tensor([[0.0, -1, 1]], dtype=torch.float64))
    torch.testing.assert_close(top[0, 0], torch.tensor([20.0, 0.0], dtype=torch.float64))  # 45 degrees up: upper edge
    sized = {"width": 64, "height": 32, "fps": 5, "frames": [{"world_from_camera": pose, "fov": 50}] * 2}
    assert path_of(sized).size.tolist() == [[64, 32]] * 2
    for document, fault in [
        ({"frames": []}, "no list of frames"),
        ([{"fov": 50}], "frame 0 needs"),
        ([{"world_from_camera": pose, "fov": 180}], "fov of frame 0 is 180"),
        ([{"world_from_camera": pose[:3], "fov": 50}], "world_from_camera of frame 0"),
        ([{"world_from_camera": (2 * torch.eye(4)).tolist(), "fov": 50}], "frame 0 has a pose whose 3x3"),
        ({"width": 0, "frames": [{"world_from_camera": pose, "fov": 50}]}, "width and height"),
    ]:
        with pytest.raises(InputError, match=fault):
            path_of(document)


def test_the_ladder_renders_rising_sizes_and_can_be_left() -> None:
    _, cameras = sphere_views(1, 16)
    field = Field(PRESETS["tiny"])
    rungs = list(render_ladder(field, cameras.to(dtype=torch.float32), 0))
    assert [tuple(r.depth.shape) for r in rungs] == [(2, 2), (4, 4), (8, 8), (16, 16)]
    assert tuple(next(render_ladder(field, cameras.to(dtype=torch.float32), 0)).depth.shape) == (2, 2)


def test_truth_of_the_geometry_benchmark(sphere: meshes.Mesh) -> None:
    """The benchmark's depths are those of `procedural_views`, and a mesh measured against itself is right."""
    _, held, depths = procedural_views("co3d", 4, 2, 16, 16, seed=1)
    for found, expected in zip(true_depths(held, "co3d", 6, 1), depths, strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-4)
    points = sample_surface(sphere, 2000)
    assert float(points.mean(0).sub(CENTRE).abs().max()) < 0.05
    row = mesh_row(sphere, points, 2000)
    assert row["chamfer"] < 1e-9  # the samples are drawn the same each time
    assert row["fscore"] == 1.0


# The command on a stored run

OVERRIDES = (
    "reconstruct.overrides={iterations: 40, batch_rays: 256, chunk_rays: 256, samples: [12, 8], grid_max: [32, 64], "
    "grid_features: [1, 2], interlevel_blur: [0.03], grid_log2_table: 12, warmup_iterations: 4, lpips_weight: 0.0}"
)


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with a field and a rendered path, made without a server."""
    from flows.jobs.request import Request

    out = tmp_path_factory.mktemp("exports")
    config = make_config({"method": "zipnerf", "preset": "fast"}, None, [OVERRIDES, "render.path_views=2"])
    [job] = Request("procedural:co3d/1?views=10&width=32&height=24", out, ("all",), config).jobs()
    with opened(job):
        run_missing(job, until="render")
    return job.store_path


def test_the_command_writes_everything_in_the_worlds_frame(stored: Path, tmp_path: Path) -> None:
    file = tmp_path / "path.json"
    truth = read_capture("procedural:co3d/1?views=10&width=32&height=24")
    assert truth.cameras is not None
    pose = truth.cameras.world_from_camera[1].tolist()
    half_height = 12 / float(truth.cameras.intrinsics[1, 1, 1])
    file.write_text(json.dumps([{"world_from_camera": pose, "fov": math.degrees(2 * math.atan(half_height))}] * 2))
    out = tmp_path / "out"
    arguments = ["export", str(stored), "--out", str(out), "--resolution", "64", "--path", str(file)]
    done = CliRunner().invoke(app, [*arguments, "--what", "mesh,points,dataset"], catch_exceptions=False)
    assert done.exit_code == 0
    ply: Any = trimesh.load(out / "mesh.ply")
    glb: Any = trimesh.load(out / "mesh.glb", force="mesh")
    assert len(ply.faces) == len(glb.faces) > 0
    assert len(open3d.io.read_point_cloud(out / "points.ply").points) > 100
    kinds = ("frame", "depth", "normals", "opacity")
    assert {p.name for p in (out / "renders").iterdir()} == {
        *(f"{kind}_{i:04d}.png" for kind in kinds for i in range(2)), "path.mp4", "depth.mp4", "normals.mp4"
    }  # fmt: skip
    # Unit normals that face the camera, in the frame of the path.
    normals = read_image(out / "renders" / "normals_0000.png")[0][..., :3].astype(float) / 127.5 - 1
    directions = image_rays(truth.cameras, 1).directions.numpy().reshape(normals.shape)
    inner = np.linalg.norm(normals, axis=-1) > 0.9
    assert inner.mean() > 0.9
    assert ((normals * directions).sum(-1)[inner] < 0.02).all()
    # Training views in the data set's own world: exactly the cameras that the reader gave.
    capture = read_capture(out / "dataset")
    train = truth.splits["all"]["train"]
    assert capture.cameras is not None
    assert len(capture) == len(train)
    expected = truth.cameras[train]
    torch.testing.assert_close(capture.cameras.world_from_camera, expected.world_from_camera, rtol=0, atol=1e-9)
    torch.testing.assert_close(capture.cameras.intrinsics, expected.intrinsics, rtol=1e-9, atol=1e-9)
    # A render of a captured camera shows what that camera saw, and no other.
    again = read_image(out / "renders" / "frame_0000.png")[0].astype(float)
    assert truth.images is not None
    assert int(np.argmin([abs(again - image).mean() for image in truth.images])) == 1


def test_both_frames_are_one_similarity_apart(stored: Path, tmp_path: Path) -> None:
    clouds = {}
    for frame in ("world", "scene"):
        export_command(stored, None, "points", tmp_path / frame, frame)
        clouds[frame] = np.asarray(open3d.io.read_point_cloud(tmp_path / frame / "points.ply").points)
    similarity = open_source(stored, "vall-zipnerf", "world").frame_from_scene
    expected = similarity.points(torch.from_numpy(clouds["scene"])).numpy()
    np.testing.assert_allclose(clouds["world"], expected, atol=1e-5)


def test_splats_of_a_run_look_like_its_field_in_the_worlds_frame(stored: Path, tmp_path: Path) -> None:
    settings = SurfaceSettings(splats=3000, refine=200)
    files = export_command(stored, None, "splats", tmp_path, "world", settings)
    assert [file.name for file in files] == ["splats.ply", "splats.splat", "splats.spz"]
    source = open_source(stored, None, "world")
    cameras = read_cameras(source.store.captured).to(dtype=torch.float32)
    wanted = source.scene.render(cameras, 1).image
    there = source.frame_from_scene.cameras(cameras)
    for file in files:
        splats = READERS[file.suffix](file)
        assert len(splats) <= 3000
        error = (render(splats, there, 1).image - wanted).square().mean()
        assert -10 * math.log10(float(error)) > 22, file.name


def test_views_of_the_run_are_exported_as_stored(stored: Path) -> None:
    views = training_images(open_source(stored, None, "world"))
    truth = read_capture("procedural:co3d/1?views=10&width=32&height=24")
    assert truth.images is not None
    for image, view in zip(views.images, truth.splits["all"]["train"], strict=True):
        np.testing.assert_array_equal(image.numpy(), truth.images[view])


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ({"what": "surfels"}, '"surfels" cannot be exported; choose among mesh'),
        ({"what": "renders"}, "--path FILE.json"),
        ({"frame": "camera"}, "no frame"),
        ({"run_name": "v3-cat3d"}, "has no run"),
        ({"path": Path("nowhere.zarr")}, "does not exist"),
    ],
)
def test_what_cannot_be_exported(change: dict[str, object], fault: str, stored: Path, tmp_path: Path) -> None:
    arguments: dict[str, Any] = {"path": stored, "run_name": None, "what": "mesh", "out": tmp_path} | change
    with pytest.raises(ValueError, match=fault):
        export_command(**arguments)


@pytest.mark.parametrize("what", ["mesh", "points", "dataset"])
def test_a_transparent_field_has_no_surface(what: str, stored: Path, tmp_path: Path) -> None:
    shutil.copytree(stored, tmp_path / "clear.zarr")
    section = SceneStore.open(tmp_path / "clear.zarr", "r+").run("vall-zipnerf").field
    section.write("grids.1.density.bias", np.array([-60.0], np.float32))
    with pytest.raises(InputError, match="There is no surface.*lower --opacity"):
        export_command(tmp_path / "clear.zarr", None, what, tmp_path / "out")


def test_settings_out_of_range_are_named() -> None:
    with pytest.raises(InputError, match="--resolution is 1"):
        SurfaceSettings(resolution=1)


def test_points_of_a_sphere_lie_on_it() -> None:
    renders, cameras = sphere_views(2)
    cloud = point_cloud(renders, cameras, max_radius=1.5)
    distance: Tensor = (cloud.points - CENTRE).norm(dim=-1)
    torch.testing.assert_close(distance, torch.full_like(distance, RADIUS), rtol=0, atol=1e-6)
