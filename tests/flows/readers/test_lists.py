"""Lists that do not match the folder: every image keeps its own camera, and what is left out is named."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from flows.errors import InputError
from flows.media.images import write_png
from flows.readers import read_capture
from tests.flows.readers.layouts import LAYOUTS, colmap_binary, colmap_text, llff, model, photos, transforms
from tests.flows.readers.test_pixels import COUNT, assert_point_is_where_cameras_see_it, drawn, small_cameras

NAMES = [f"{i:03d}.png" for i in range(COUNT)]
POSITIONAL = ("co3d_poses",)  # its file has neither names nor numbers


@pytest.fixture
def cameras():
    return small_cameras(64, 48)


def _images(path: Path) -> list[Path]:
    return sorted(path.rglob("*.png"))


@pytest.mark.parametrize("name", [n for n in LAYOUTS if n not in POSITIONAL])
def test_a_gap_in_the_images_moves_no_camera(tmp_path, cameras, name):
    path = LAYOUTS[name](tmp_path, cameras, drawn(cameras), NAMES)
    _images(tmp_path)[2].unlink()
    capture = read_capture(path)
    assert len(capture) == COUNT - 1
    assert_point_is_where_cameras_see_it(capture)
    assert any("left out" in note for note in capture.notes)


@pytest.mark.parametrize("name", [n for n in LAYOUTS if n not in (*POSITIONAL, "llff", "nerf_synthetic")])
def test_an_image_without_a_camera_is_left_out_and_named(tmp_path, cameras, name):
    path = LAYOUTS[name](tmp_path, cameras, drawn(cameras), NAMES)
    folder = _images(tmp_path)[0].parent
    extra = folder / ("999.png" if name != "realestate10k" else "77.png")
    write_png(extra, np.zeros((48, 64, 3), np.uint8))
    capture = read_capture(path)
    assert len(capture) == COUNT
    assert_point_is_where_cameras_see_it(capture)
    assert any(extra.name in note and "left out" in note for note in capture.notes)


def test_poses_without_names_and_too_few_images_are_refused(tmp_path, cameras):
    path = LAYOUTS["co3d_poses"](tmp_path, cameras, drawn(cameras), NAMES)
    _images(tmp_path)[2].unlink()
    with pytest.raises(InputError, match="has 5 cameras .* for the 4 images"):
        read_capture(path)


def test_llff_rows_are_those_of_the_colmap_model_beside_it(tmp_path, cameras):
    names = ["a.png", "b.png", "c.png", "d.png", "e.png"]
    llff(tmp_path, cameras, drawn(cameras), names)
    (tmp_path / "sparse" / "0").mkdir(parents=True)
    model(cameras, names).write_binary(str(tmp_path / "sparse" / "0"))
    write_png(tmp_path / "images" / "bb.png", np.zeros((48, 64, 3), np.uint8))
    (tmp_path / "images" / "d.png").unlink()
    capture = read_capture(tmp_path)
    assert capture.names == ["a.png", "b.png", "c.png", "e.png"]
    assert_point_is_where_cameras_see_it(capture)
    assert any("bb.png" in n for n in capture.notes)


def test_llff_rows_are_those_of_the_full_size_images(tmp_path, cameras):
    names = ["a.png", "b.png", "c.png", "d.png", "e.png"]
    llff(tmp_path, cameras, drawn(cameras), names)
    small = cameras.resize(32, 24)
    (tmp_path / "images_2").mkdir()
    for name, image in list(zip(names, drawn(small), strict=True))[1:]:
        write_png(tmp_path / "images_2" / name, image)
    assert_point_is_where_cameras_see_it(read_capture(tmp_path))


def test_dtu_numbers_from_one_and_masks_by_name(tmp_path, cameras):
    LAYOUTS["dtu"](tmp_path, cameras, drawn(cameras), [f"rect_{i + 1:03d}_3_r5000.png" for i in range(COUNT)])
    (tmp_path / "image" / "rect_002_3_r5000.png").unlink()
    (tmp_path / "mask").mkdir()
    for i in (1, 3, 5):
        write_png(tmp_path / "mask" / f"rect_{i:03d}_3_r5000.png", np.full((48, 64, 3), 255, np.uint8))
    capture = read_capture(tmp_path)
    assert_point_is_where_cameras_see_it(capture)
    assert [m and m.name[5:8] for m in capture.masks] == ["001", "003", None, "005"]


@pytest.mark.parametrize("style", ["no observation lines", "blank lines between", "windows", "byte order mark"])
def test_images_txt_by_hand(tmp_path, cameras, style):
    colmap_text(tmp_path, cameras, drawn(cameras), NAMES)
    file = tmp_path / "sparse" / "0" / "images.txt"
    lines = [line for line in file.read_text().splitlines() if line.endswith(".png")]
    text = {
        "no observation lines": "\n".join(lines),
        "blank lines between": "\n\n\n".join(lines) + "\n\n",
        "windows": "\r\n\r\n".join(lines) + "\r\n",
        "byte order mark": "\ufeff" + "\n\n".join(lines),
    }[style]
    file.write_bytes(text.encode())
    (tmp_path / "sparse" / "0" / "points3D.txt").unlink()
    capture = read_capture(tmp_path)
    assert capture.names == NAMES
    assert_point_is_where_cameras_see_it(capture)


def test_observations_are_no_images(tmp_path, cameras):
    colmap_text(tmp_path, cameras, drawn(cameras), NAMES)
    file = tmp_path / "sparse" / "0" / "images.txt"
    lines = [line for line in file.read_text().splitlines() if line.endswith(".png")]
    file.write_text("\n".join(f"{line}\n1.5 2.5 -1 3.5 4.5 7 5 6 8 9 10 11" for line in lines))
    assert read_capture(tmp_path).names == NAMES


def test_the_largest_of_several_models_is_taken_and_any_can_be_named(tmp_path, cameras):
    colmap_text(tmp_path, cameras, drawn(cameras), NAMES)
    (tmp_path / "sparse" / "0").rename(tmp_path / "sparse" / "1")
    (tmp_path / "sparse" / "0").mkdir()
    model(cameras[[0, 1]], NAMES[:2]).write_text(str(tmp_path / "sparse" / "0"))
    capture = read_capture(tmp_path)
    assert len(capture) == COUNT
    assert any("left out: 0 (2 images)" in n for n in capture.notes)
    smaller = read_capture(tmp_path / "sparse" / "0")
    assert smaller.names == NAMES[:2]
    assert smaller.scene_id == f"{tmp_path.name}_sparse_0"
    assert_point_is_where_cameras_see_it(smaller)


def test_our_model_reader_agrees_with_pycolmaps(tmp_path, cameras):
    from flows.readers.colmap_model import LENGTHS, MODELS, load_model

    for i, (name, length) in enumerate(MODELS):
        known = pycolmap.Camera.create_from_model_name(1, name, 5.0, 10, 10)
        assert (int(known.model), len(known.params)) == (i, length)
    written = model(cameras, NAMES)
    for point in np.random.default_rng(0).random((7, 3)):
        written.add_point3D(point, pycolmap.Track(), np.zeros(3, np.uint8))
    for kind in ("binary", "text"):
        folder = tmp_path / kind
        folder.mkdir()
        getattr(written, f"write_{kind}")(str(folder))
        ours, theirs = load_model(folder), pycolmap.Reconstruction(str(folder))
        by_name = {im.name: im for im in theirs.images.values()}
        assert sorted(im.name for im in ours.images) == sorted(by_name)
        for mine in ours.images:
            other = by_name[mine.name]
            np.testing.assert_allclose(mine.camera_from_world[:3], other.cam_from_world().matrix(), atol=1e-12)
        np.testing.assert_allclose(
            np.sort(ours.points, 0), np.sort([p.xyz for p in theirs.points3D.values()], 0), atol=1e-12
        )
    assert LENGTHS["OPENCV"] == 8


def test_transforms_comes_before_a_model_and_says_so(tmp_path, cameras):
    transforms(tmp_path, cameras[[0, 1, 2]], drawn(cameras)[:3], NAMES[:3])
    colmap_binary(tmp_path, cameras, drawn(cameras), NAMES)
    capture = read_capture(tmp_path)
    assert len(capture) == 3
    assert any("--reader colmap takes that instead" in n for n in capture.notes)
    assert any("003.png, 004.png" in n for n in capture.notes)
    assert len(read_capture(tmp_path, reader="colmap")) == COUNT


def _header(folder: Path, **changes) -> None:
    content = json.loads((folder / "transforms.json").read_text()) | changes
    (folder / "transforms.json").write_text(json.dumps(content))


def test_the_files_own_split_is_used(tmp_path, cameras):
    transforms(tmp_path, cameras, drawn(cameras), NAMES)
    lists = {"train": NAMES[:2], "val": NAMES[2:3], "test": NAMES[3:4]}
    _header(tmp_path, **{f"{role}_filenames": [f"./images\\{n}" for n in names] for role, names in lists.items()})
    capture = read_capture(tmp_path)
    assert capture.splits["all"] == {"train": [0, 1], "test": [3]}
    assert capture.splits["1"] == {"train": [0], "test": [3]}
    assert any("002.png, images/004.png" in n for n in capture.notes)
    _header(tmp_path, test_filenames=[])
    assert read_capture(tmp_path).splits["all"] == {"train": [0, 1], "test": [2]}
    _header(tmp_path, val_filenames=[f"images/{NAMES[0]}"])
    with pytest.raises(InputError, match="in train_filenames and in val_filenames"):
        read_capture(tmp_path)
    _header(tmp_path, val_filenames=[3])
    with pytest.raises(InputError, match="is not a list of file names"):
        read_capture(tmp_path)


def test_only_held_out_views_listed_leaves_the_others_for_training(tmp_path, cameras):
    transforms(tmp_path, cameras, drawn(cameras), NAMES)
    _header(tmp_path, test_filenames=["images/001.png", "images/none.png"])
    capture = read_capture(tmp_path)
    assert capture.splits["all"] == {"train": [0, 2, 3, 4], "test": [1]}
    assert any("images/none.png" in n for n in capture.notes)


def test_keys_that_are_not_used_are_named(tmp_path, cameras):
    transforms(tmp_path, cameras, drawn(cameras), NAMES)
    _header(tmp_path, aabb_scale=4, ply_file_path="x.ply", applied_scale=1.0)
    assert "Of the file's keys these are not used: aabb_scale, ply_file_path." in read_capture(tmp_path).notes


def test_applied_scale_is_undone(tmp_path, cameras):
    transforms(tmp_path, cameras, drawn(cameras), NAMES)
    content = json.loads((tmp_path / "transforms.json").read_text())
    for frame in content["frames"]:
        for row in frame["transform_matrix"][:3]:
            row[3] *= 3.0
    _header(tmp_path, frames=content["frames"], applied_scale=3.0)
    assert_point_is_where_cameras_see_it(read_capture(tmp_path))


def test_photos_in_subfolders(tmp_path):
    images = [np.full((8, 8, 3), i, np.uint8) for i in range(4)]
    photos(tmp_path / "one" / "DCIM", None, images, ["a.jfif", "b.JPG", "c.jpe", "d.jpg"], _jpeg)
    assert read_capture(tmp_path / "one").names == ["a.jfif", "b.JPG", "c.jpe", "d.jpg"]
    photos(tmp_path / "two", None, images, ["left/a.png", "right/b.png", "mask/a.png", "mask/b.png"])
    two = read_capture(tmp_path / "two")
    assert two.names == ["left/a.png", "right/b.png"]
    assert any("mask (2)" in n for n in two.notes)
    photos(tmp_path / "three", None, images, ["left/a.png", "right/a.png", "left/b.png", "right/b.png"])
    with pytest.raises(InputError, match=r"same names in several folders: left \(2\), right \(2\)"):
        read_capture(tmp_path / "three")
    assert read_capture(tmp_path / "three", image_folder="right").names == ["a.png", "b.png"]
    photos(tmp_path / "four", None, images, ["a.png", "b.png", "old/a.png", "old/b.png"])
    four = read_capture(tmp_path / "four")
    assert four.names == ["a.png", "b.png"]
    assert any("old (2)" in n and "--images NAME" in n for n in four.notes)


def test_a_photo_is_known_by_its_bytes_and_other_files_are_named(tmp_path):
    photos(tmp_path, None, [np.zeros((8, 8, 3), np.uint8)], ["a.jpg"], _jpeg)
    (tmp_path / "a.jpg").rename(tmp_path / "IMG_0001")
    (tmp_path / "clip.mp4").write_bytes(b"x")
    (tmp_path / "notes.txt").write_text("x")
    capture = read_capture(tmp_path)
    assert capture.names == ["IMG_0001"]
    assert any("clip.mp4" in n for n in capture.notes)


def _jpeg(path: Path, pixels: np.ndarray) -> None:
    from PIL import Image

    Image.fromarray(pixels).save(path, format="JPEG")
