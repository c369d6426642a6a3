"""The small inputs from the field that once came out wrong, with what is right for each (skips where they are absent).

Their like is built in test_pixels, test_lists and test_odd_names, which run anywhere.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from flows.readers import read_capture
from flows.stages.ingest import ingest_view
from schemas.config import IngestConfig


@pytest.fixture(scope="module")
def cases(shared_data) -> Path:
    folder = shared_data.parent / "cases"
    if not folder.is_dir():
        pytest.skip(f"The cases are not on this machine ({folder}).")
    return folder


EXPECTED = {
    # folder: (scene name in the store or None for the folder's own, views, what the notes say)
    "colmap_backslash_names": (None, 12, ""),
    "colmap_txt_spaces": (None, 12, ""),
    "colmap_two_models": (None, 10, "left out: 0 (2 images)"),
    "colmap_unregistered": (None, 7, "007.png, 008.png, 009.png, 010.png, 011.png"),
    "dtu_gap": (None, 24, "world_mat_2"),
    "exif3_colmap": (None, 16, "which was ignored"),
    "exif3_transforms": (None, 12, "which was ignored"),
    "exif6_portrait_colmap": (None, 12, "which was ignored"),
    "my scene": ("my_scene-db519d52", 12, ""),
    "photos_jfif": (None, 8, ""),
    "transforms_absolute": (None, 12, "by the last parts of their paths"),
    "transforms_and_colmap": (None, 8, "--reader colmap takes that instead"),
    "transforms_backslash_images_option": (None, 12, ""),
    "transforms_bom": (None, 12, ""),
    "transforms_mask_path": (None, 12, "mask_path"),
    "transforms_no_wh_downscaled": (None, 16, "4 times as large"),
}


@pytest.mark.parametrize("name", EXPECTED)
def test_each_case_is_read_right(cases, name):
    scene, count, said = EXPECTED[name]
    capture = read_capture(cases / name)
    assert (capture.scene_id, capture.title, len(capture)) == (scene or name, name, count)
    assert any(said in note for note in capture.notes)
    got = ingest_view(capture, 0, IngestConfig())
    if capture.cameras is not None:
        assert got.image.shape[1::-1] == tuple(capture.cameras.size[0].tolist())


def test_the_dtu_gap_is_like_the_right_answer(cases):
    gap, right = (read_capture(cases / name).cameras for name in ("dtu_gap", "dtu_gap_right_answer"))
    torch.testing.assert_close(gap.world_from_camera, right.world_from_camera)
    torch.testing.assert_close(gap.intrinsics, right.intrinsics)


def test_tagged_photos_keep_their_stored_pixels(cases):
    from PIL import Image

    for name in ("exif3_colmap", "exif3_transforms", "exif6_portrait_colmap"):
        capture = read_capture(cases / name)
        for view in range(len(capture)):
            stored = np.asarray(Image.open(capture.paths[view]).convert("RGB"))
            got = ingest_view(capture, view, IngestConfig()).image
            assert np.abs(got.astype(int) - stored).mean() < 1


def test_the_masks_are_read_and_keep_pixels_out_of_training(cases):
    capture = read_capture(cases / "transforms_mask_path")
    assert capture.mask_training
    assert ingest_view(capture, 0, IngestConfig()).mask is not None


def test_intrinsics_of_four_times_larger_images(cases):
    k = read_capture(cases / "transforms_no_wh_downscaled").cameras.intrinsics[0]
    assert (k[0, 2], k[1, 2], k[0, 0]) == (48, 32, pytest.approx(326.5023615940405 / 4))


def test_backslashes_with_another_image_folder(cases):
    if not any((cases / "transforms_backslash_images_option" / "images_2").iterdir()):
        pytest.skip("images_2 is empty")
    capture = read_capture(cases / "transforms_backslash_images_option", image_folder="images_2")
    assert capture.paths[0].parent.name == "images_2"
