"""Pixels and cameras belong together: a point that was drawn where its camera sees it is found where the capture says.

Every layout, every EXIF orientation, wide and square images.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from cat3d_core.cameras import Cameras
from flows.errors import InputError
from flows.media.images import write_png
from flows.readers import read_capture
from flows.stages.ingest import ingest_view
from schemas.config import IngestConfig
from tests.flows.readers.layouts import LAYOUTS, header, photos, transforms

POINT = torch.tensor([[0.5, -0.2, 5.0]], dtype=torch.float64)
COUNT = 5
# How a stored image has to be turned to be upright, by its orientation (EXIF 2.3, tag 0x0112).
UPRIGHT = {
    1: lambda a: a,
    2: lambda a: a[:, ::-1],
    3: lambda a: a[::-1, ::-1],
    4: lambda a: a[::-1],
    5: lambda a: a.swapaxes(0, 1),
    6: lambda a: np.rot90(a, -1),
    7: lambda a: np.rot90(a.swapaxes(0, 1), 2),
    8: lambda a: np.rot90(a, 1),
}
DECLARED = ("transforms", "transforms_per_frame", "reconfusion", "nerf_synthetic", "colmap_binary", "colmap_text") + (
    "llff",
    "co3d",
    "strecha",
)


def small_cameras(width: int, height: int) -> Cameras:
    """Five cameras with the principal point in the middle, looking along +z from a slanted row."""
    poses = torch.eye(4, dtype=torch.float64).repeat(COUNT, 1, 1)
    poses[:, 0, 3] = torch.linspace(-0.6, 0.9, COUNT)
    poses[:, 1, 3] = torch.linspace(0.3, -0.5, COUNT)
    k = torch.tensor([[70.0, 0, width / 2], [0, 70.0, height / 2], [0, 0, 1]], dtype=torch.float64)
    return Cameras(k.repeat(COUNT, 1, 1), poses, torch.tensor([[width, height]]).repeat(COUNT, 1))


def drawn(cameras: Cameras) -> list[np.ndarray]:
    """Images, black but for a white spot of 5 x 5 pixels round the point."""
    out = []
    for (x, y), (width, height) in zip(cameras.project(POINT)[0][:, 0].tolist(), cameras.size.tolist(), strict=True):
        image = np.zeros((height, width, 3), np.uint8)
        image[int(y) - 2 : int(y) + 3, int(x) - 2 : int(x) + 3] = 255
        out.append(image)
    return out


def assert_point_is_where_cameras_see_it(capture, settings=None) -> None:
    for view in range(len(capture)):
        got = ingest_view(capture, view, settings or IngestConfig())
        height, width = got.image.shape[:2]
        camera = Cameras(
            got.intrinsics[None], capture.cameras.world_from_camera[[view]], torch.tensor([[width, height]])
        )
        expected = camera.project(POINT)[0][0, 0].numpy()
        weight = got.image.mean(-1).astype(float)
        rows, columns = np.mgrid[:height, :width] + 0.5
        found = np.array([(weight * columns).sum(), (weight * rows).sum()]) / weight.sum()
        np.testing.assert_allclose(found, expected, atol=1.0)


def jpeg_with(orientation: int):
    def save(path: Path, pixels: np.ndarray) -> None:
        exif = Image.Exif()
        exif[0x0112] = orientation
        Image.fromarray(np.ascontiguousarray(pixels)).save(path, format="JPEG", quality=95, exif=exif)

    return save


@pytest.mark.parametrize("size", [(64, 48), (56, 56)], ids=["wide", "square"])
@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("name", LAYOUTS)
def test_given_cameras_are_for_the_pixels_as_stored(tmp_path, name, orientation, size):
    cameras = small_cameras(*size)
    names = [f"{i:03d}.jpg" for i in range(COUNT)]
    capture = read_capture(LAYOUTS[name](tmp_path, cameras, drawn(cameras), names, jpeg_with(orientation)))
    assert_point_is_where_cameras_see_it(capture)
    assert any("EXIF orientation, which was ignored" in n for n in capture.notes) == (orientation > 1)


@pytest.mark.parametrize("orientation", range(5, 9))
@pytest.mark.parametrize("name", DECLARED)
def test_where_the_size_fits_only_the_upright_image_it_is_turned(tmp_path, name, orientation):
    cameras = small_cameras(64, 48)
    names = [f"{i:03d}.jpg" for i in range(COUNT)]
    inverse = {6: 8, 8: 6}.get(orientation, orientation)
    stored = [UPRIGHT[inverse](image) for image in drawn(cameras)]
    np.testing.assert_array_equal(UPRIGHT[orientation](stored[0]), drawn(cameras)[0])
    capture = read_capture(LAYOUTS[name](tmp_path, cameras, stored, names, jpeg_with(orientation)))
    assert capture.upright
    assert any("they were turned upright" in n for n in capture.notes)
    assert_point_is_where_cameras_see_it(capture)


def test_some_turned_and_some_not_is_refused(tmp_path):
    cameras = small_cameras(64, 48)

    def save(path: Path, pixels: np.ndarray) -> None:
        jpeg_with(6)(path, UPRIGHT[8](pixels) if path.stem == "002" else pixels)

    with pytest.raises(InputError, match="as stored, that of .* turned by its EXIF orientation"):
        read_capture(transforms(tmp_path, cameras, drawn(cameras), [f"{i:03d}.jpg" for i in range(COUNT)], save))


@pytest.mark.parametrize("orientation", range(1, 9))
def test_plain_photos_are_turned_upright(tmp_path, orientation):
    image = drawn(small_cameras(64, 48))[0]
    photos(tmp_path / "x", None, [image] * 2, ["a.jpg", "b.jpg"], jpeg_with(orientation))
    capture = read_capture(tmp_path / "x")
    got = ingest_view(capture, 0, IngestConfig()).image
    assert np.abs(got.astype(int) - UPRIGHT[orientation](image)).mean() < 2


@pytest.mark.parametrize("factor", [2, 4, 8, 3.1])
def test_intrinsics_of_another_size_are_scaled_by_their_principal_point(tmp_path, factor):
    cameras = small_cameras(64, 48)
    images = drawn(cameras)
    larger = Cameras(cameras.intrinsics.clone(), cameras.world_from_camera, cameras.size)
    larger.intrinsics[:, :2] *= factor
    transforms(tmp_path, larger, images, [f"{i:03d}.png" for i in range(COUNT)])
    _without(tmp_path, "w", "h")
    capture = read_capture(tmp_path)
    assert_point_is_where_cameras_see_it(capture)
    assert any("The principal point" in n for n in capture.notes)


def test_intrinsics_of_another_image_folder_are_found_there(tmp_path):
    cameras = small_cameras(64, 48)
    larger = cameras.resize(250, 188)  # no whole factor
    names = [f"{i:03d}.png" for i in range(COUNT)]
    transforms(tmp_path, larger, drawn(cameras), names)
    for name, image in zip(names, drawn(larger), strict=True):
        (tmp_path / "full").mkdir(exist_ok=True)
        write_png(tmp_path / "full" / name, image)
    _without(tmp_path, "w", "h")
    assert_point_is_where_cameras_see_it(read_capture(tmp_path))


def test_smaller_images_by_option_keep_the_named_images_intrinsics(tmp_path):
    cameras = small_cameras(64, 48)
    names = [f"{i:03d}.png" for i in range(COUNT)]
    transforms(tmp_path, cameras, drawn(cameras), names)
    (tmp_path / "images_2").mkdir()
    for name, image in zip(names, drawn(cameras.resize(32, 24)), strict=True):
        write_png(tmp_path / "images_2" / name, image)
    _without(tmp_path, "w", "h", "cx", "cy")
    assert_point_is_where_cameras_see_it(read_capture(tmp_path, image_folder="images_2"))


def test_a_principal_point_that_fits_no_size_is_refused(tmp_path):
    cameras = small_cameras(64, 48)
    cameras.intrinsics[:, 0, 2] = 300.0
    transforms(tmp_path, cameras, drawn(small_cameras(64, 48)), [f"{i:03d}.png" for i in range(COUNT)])
    _without(tmp_path, "w", "h")
    with pytest.raises(InputError, match="add the width and height of the images that were calibrated"):
        read_capture(tmp_path)


def _without(folder: Path, *keys: str) -> None:
    import json

    content = json.loads((folder / "transforms.json").read_text())
    for key in keys:
        content.pop(key)
    (folder / "transforms.json").write_text(json.dumps(content))


def test_header_helper_says_the_size(tmp_path):
    assert header(small_cameras(64, 48))["w"] == 64
