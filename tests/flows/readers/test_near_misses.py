"""What people point at that is not quite a scene's folder: done, or refused with the next step."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
import torch

from cat3d_core.cameras import Cameras
from flows.errors import InputError
from flows.media.frames import sharpness
from flows.media.images import write_png
from flows.media.lens import distort
from flows.media.video import write_video
from flows.readers import read_capture
from flows.stages.ingest import ingest_view
from schemas.config import IngestConfig
from tests.flows.readers.layouts import LAYOUTS, colmap_text, photos, transforms
from tests.flows.readers.test_pixels import COUNT, assert_point_is_where_cameras_see_it, drawn, small_cameras

NAMES = [f"{i:03d}.png" for i in range(COUNT)]
FILE_OF = {
    "transforms": "transforms.json",
    "nerf_synthetic": "transforms_train.json",
    "llff": "poses_bounds.npy",
    "dtu": "cameras_sphere.npz",
    "co3d_poses": "gt_cameras.npz",
    "colmap_binary": "sparse/0/cameras.bin",
    "colmap_text": "sparse/0/images.txt",
    "realestate10k": "0123456789abcdef.txt",
    "strecha": "gt_dense_cameras/000.png.camera",
}


@pytest.mark.parametrize("name", FILE_OF)
def test_a_file_of_the_layout_stands_for_its_scene(tmp_path, name):
    cameras = small_cameras(64, 48)
    LAYOUTS[name](tmp_path / "scene", cameras, drawn(cameras), NAMES)
    capture = read_capture(tmp_path / "scene" / FILE_OF[name])
    assert len(capture) == COUNT
    assert_point_is_where_cameras_see_it(capture)


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("scene.zip", "is an archive; unpack it and give the folder"),
        ("scene.tar.gz", "is an archive; unpack it"),
        ("frame_annotations.jgz", "give the folder of one of its sequences"),
        ("points.ply", "give the folder with the photos, a video, or a transforms.json"),
        ("film.mp4", "is not a video that ffmpeg can read"),
        ("nowhere", "does not exist; give the folder of a scene"),
    ],
)
def test_other_files_are_refused_with_the_next_step(tmp_path, name, said):
    if name != "nowhere":
        (tmp_path / name).write_bytes(b"nothing")
    with pytest.raises(InputError, match=re.escape(said)):
        read_capture(tmp_path / name)


def test_a_folder_round_the_scene_is_refused_with_its_name(tmp_path):
    cameras = small_cameras(64, 48)
    transforms(tmp_path / "unzipped" / "scene", cameras, drawn(cameras), NAMES)
    (tmp_path / "unzipped" / "scene" / "images" / "deep").mkdir()
    # A folder of images inside a folder looks like photos; the transforms.json below it must not be passed over.
    with pytest.raises(InputError, match=r"such as .*unzipped/scene\."):
        read_capture(tmp_path / "unzipped")


@pytest.mark.parametrize("name", ["transforms", "nerf_synthetic", "realestate10k", "strecha", "colmap_text"])
def test_a_byte_order_mark_and_windows_lines(tmp_path, name):
    cameras = small_cameras(64, 48)
    path = LAYOUTS[name](tmp_path, cameras, drawn(cameras), NAMES)
    for file in [*tmp_path.rglob("*.json"), *tmp_path.rglob("*.txt"), *tmp_path.rglob("*.camera")]:
        file.write_bytes(b"\xef\xbb\xbf" + file.read_bytes().replace(b"\n", b"\r\n"))
    capture = read_capture(path)
    assert len(capture) == COUNT
    assert_point_is_where_cameras_see_it(capture)


def test_absolute_paths_and_links_inside_the_scene(tmp_path):
    cameras = small_cameras(64, 48)
    transforms(tmp_path, cameras, drawn(cameras), NAMES)
    (tmp_path / "images").rename(tmp_path / "photos")
    (tmp_path / "images").symlink_to(tmp_path / "photos")
    content = json.loads((tmp_path / "transforms.json").read_text())
    for frame, start in zip(content["frames"], [f"{tmp_path}/", "C:\\Users\\me\\scene\\", "/home/me/x/", "../", "./"]):
        frame["file_path"] = start + frame["file_path"]
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    capture = read_capture(tmp_path)
    assert len(capture) == COUNT
    assert_point_is_where_cameras_see_it(capture)


def test_frames_of_a_video_are_the_sharpest_of_their_stretch(tmp_path):
    noise = np.random.default_rng(0).integers(0, 256, (48, 64), dtype=np.uint8).repeat(4, 0).repeat(4, 1)
    sharp = np.stack([noise] * 3, -1)
    soft = np.full_like(sharp, 128)
    frames = [np.clip(sharp if i % 6 == 2 else soft, i, 255 - i).astype(np.uint8) for i in range(48)]
    write_video(tmp_path / "clip [1].mp4", frames, fps=24)
    capture = read_capture(tmp_path / "clip [1].mp4", frames=8)
    assert len(capture) == 8
    assert capture.cameras is None
    assert len(set(capture.image_digests)) == 8
    assert all(sharpness(capture.images[i].mean(-1)) > 100 for i in range(8))
    assert ingest_view(capture, 3, IngestConfig()).image.shape == (192, 256, 3)
    many = read_capture(tmp_path / "clip [1].mp4", frames=500)
    assert len(many) == 48
    assert any("no 500 frames" in n for n in many.notes)


def test_heic_photos_are_read_or_refused_with_the_next_step(tmp_path):
    image = np.full((48, 64, 3), 90, np.uint8)
    photos(tmp_path, None, [image] * 2, ["a.png", "b.png"])
    try:
        import pillow_heif
    except ImportError:
        (tmp_path / "IMG_1.HEIC").write_bytes(b"ftypheic")
        with pytest.raises(InputError, match=r"pip install 'cat3d\[heic\]'"):
            read_capture(tmp_path)
        return
    pillow_heif.from_bytes("RGB", (64, 48), image.tobytes()).save(str(tmp_path / "IMG_1.HEIC"), quality=90)
    capture = read_capture(tmp_path)
    assert capture.names == ["IMG_1.HEIC", "a.png", "b.png"]
    got = ingest_view(capture, 0, IngestConfig()).image
    assert np.abs(got.astype(int) - image).max() < 4
    (tmp_path / "IMG_2.HEIC").write_bytes(b"broken")
    with pytest.raises(InputError, match="is not a HEIC/AVIF file that can be read"):
        read_capture(tmp_path)


LENSES = {
    "OPENCV_FISHEYE": {"k1": 0.05, "k2": -0.01, "k3": 0.004, "k4": -0.001},
    "SIMPLE_RADIAL_FISHEYE": {"k1": 0.08},
    "FULL_OPENCV": {"k1": 0.1, "k2": 0.02, "p1": 0.002, "p2": -0.001, "k3": 0.01, "k4": 0.05, "k5": 0.01, "k6": 0.003},
}


@pytest.mark.parametrize("by", ["transforms", "colmap"])
@pytest.mark.parametrize("lens", LENSES)
def test_lenses_are_undistorted_on_ingest(tmp_path, lens, by):
    """The spot is drawn where the lens puts the point; it must come out where the pinhole camera sees it."""
    cameras, values = small_cameras(128, 96), LENSES[lens]
    fisheye = "FISHEYE" in lens
    order = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    coefficients = torch.tensor([values.get(k, 0.0) for k in order], dtype=torch.float64)
    pixels = cameras.project(torch.tensor([[0.5, -0.2, 3.0]], dtype=torch.float64))[0][:, 0]
    rays = (pixels - cameras.intrinsics[:, :2, 2]) / cameras.intrinsics[:, [0, 1], [0, 1]]
    bent = distort(rays, coefficients, fisheye) * cameras.intrinsics[:, [0, 1], [0, 1]] + cameras.intrinsics[:, :2, 2]
    images = []
    for x, y in bent.tolist():
        image = np.zeros((96, 128, 3), np.uint8)
        image[int(y) - 1 : int(y) + 2, int(x) - 1 : int(x) + 2] = 255
        images.append(image)
    if by == "transforms":
        transforms(tmp_path, cameras, images, NAMES)
        content = json.loads((tmp_path / "transforms.json").read_text()) | {"camera_model": lens} | values
        (tmp_path / "transforms.json").write_text(json.dumps(content))
    else:
        colmap_text(tmp_path, cameras, images, NAMES)
        focal = "70" if lens.startswith("SIMPLE") else "70 70"
        numbers = " ".join(str(values[k]) for k in order if k in values)
        (tmp_path / "sparse/0/cameras.txt").write_text(f"1 {lens} 128 96 {focal} 64 48 {numbers}\n")
    capture = read_capture(tmp_path)
    for view in range(COUNT):
        got = ingest_view(capture, view, IngestConfig())
        camera = Cameras(got.intrinsics[None], cameras.world_from_camera[[view]], torch.tensor([[128, 96]]))
        expected = camera.project(torch.tensor([[0.5, -0.2, 3.0]], dtype=torch.float64))[0][0, 0].numpy()
        weight = got.image.mean(-1).astype(float)
        rows, columns = np.mgrid[:96, :128] + 0.5
        found = np.array([(weight * columns).sum(), (weight * rows).sum()]) / weight.sum()
        np.testing.assert_allclose(found, expected, atol=1.2)


def test_full_opencv_without_higher_terms_is_opencv(tmp_path):
    cameras = small_cameras(64, 48)
    colmap_text(tmp_path, cameras, drawn(cameras), NAMES)
    (tmp_path / "sparse/0/cameras.txt").write_text("1 FULL_OPENCV 64 48 70 70 32 24 0.1 0.01 0.001 0.002 0 0 0 0\n")
    capture = read_capture(tmp_path)
    assert capture.distortion[0].tolist() == [0.1, 0.01, 0.001, 0.002, 0.0]
    assert capture.fisheye is None


def test_an_image_of_black_mask_is_refused(tmp_path):
    cameras = small_cameras(64, 48)
    transforms(tmp_path, cameras, drawn(cameras), NAMES)
    content = json.loads((tmp_path / "transforms.json").read_text())
    content["frames"][0]["mask_path"] = "masks/000.png"
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match="names masks, but none of them exists"):
        read_capture(tmp_path)
    (tmp_path / "masks").mkdir()
    write_png(tmp_path / "masks" / "000.png", np.zeros((48, 64, 3), np.uint8))
    with pytest.raises(InputError, match="black everywhere"):
        ingest_view(read_capture(tmp_path), 0, IngestConfig())
