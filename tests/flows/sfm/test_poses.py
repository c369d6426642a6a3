"""Poses from photos, against known cameras: ray-traced photos (no data needed) and real scenes."""

from __future__ import annotations

import math

import numpy as np
import OpenImageIO as oiio
import pytest
import torch

from cat3d_core.alignment import pose_errors
from flows.errors import InputError
from flows.media.images import write_png
from flows.readers import read_capture
from flows.sfm.mapping import PoseSettings, image_pairs
from flows.sfm.poses import PoseError, estimate_poses


@pytest.fixture(scope="module")
def fern(shared_data):
    return read_capture(shared_data / "llff_fern")


def _estimate(capture, ids, **keys):
    result = estimate_poses([capture.paths[i] for i in ids], settings=PoseSettings(max_features=2000), **keys)
    return result, pose_errors(result.cameras, capture.cameras[[ids[i] for i in result.registered]])


def test_poses_of_real_photos_with_progress_and_the_same_twice(fern):
    ids = [0, 1, 2, 5, 6, 7]
    steps = []
    result, errors = _estimate(fern, ids, on_progress=lambda *step: steps.append(step))
    assert result.registered == list(range(6))
    assert errors.rotation_deg.max() < 1.5
    assert errors.center_share.max() < 0.05
    # A few photos fix the focal length only roughly.
    assert (result.cameras.intrinsics[0, 0, 0] / fern.cameras.intrinsics[0, 0, 0] - 1).abs() < 0.2
    assert result.report.shared_camera
    assert "6 of 6 photos registered" in result.report.summary()
    for name in ("features", "matching"):
        done = [s for s in steps if s[0] == name]
        assert done[-1][1] == done[-1][2]
    # What the points project to lies in the photos.
    pixels, depth = result.cameras.project(result.points)
    assert ((depth > 0) & (pixels > 0).all(-1) & (pixels < result.cameras.size[:, None]).all(-1)).sum(0).min() >= 2
    again, _ = _estimate(fern, ids)
    assert torch.equal(result.cameras.world_from_camera, again.cameras.world_from_camera)
    assert torch.equal(result.cameras.intrinsics, again.cameras.intrinsics)
    assert torch.equal(result.points, again.points)


def test_three_wide_photos_need_the_relaxed_attempt(shared_data):
    flower = read_capture(shared_data / "llff_flower")
    result, errors = _estimate(flower, flower.splits["3"]["train"])
    assert result.registered == [0, 1, 2]
    assert "relaxed" in result.report.attempt
    assert errors.rotation_deg.max() < 6
    assert errors.center_share.max() < 0.06


@pytest.mark.slow
@pytest.mark.parametrize("scene", ["strecha_fountain_P11", "dtu_scan24", "llff_fern", "fox"])
def test_poses_of_whole_real_scenes(shared_data, scene):
    capture = read_capture(shared_data / scene)
    ids = list(range(0, len(capture), max(1, len(capture) // 16)))
    result, errors = _estimate(capture, ids)
    assert len(result.registered) == len(ids)
    assert errors.rotation_deg.max() < 1.5
    assert errors.center_share.max() < 0.03


def test_working_size_and_mixed_sizes_give_intrinsics_of_each_photo(fern, tmp_path):
    from flows.media.images import read_image, resize

    photos = [read_image(fern.paths[i])[0] for i in (0, 1, 2, 5, 6, 7)]
    photos[2] = resize(photos[2], 756, 567)
    result = estimate_poses(photos, settings=PoseSettings(max_features=2000, long_side_px=504))
    assert not result.report.shared_camera
    assert result.cameras.size[result.registered.index(2)].tolist() == [756, 567]
    focals = result.cameras.intrinsics[:, 0, 0] / result.cameras.size[:, 0]
    assert result.cameras.intrinsics[result.registered.index(2), 0, 2] == pytest.approx(378)
    assert focals.max() / focals.min() < 1.4


def test_photos_of_nothing_in_common_fail_with_advice(tmp_path):
    rng = np.random.default_rng(0)
    photos = [np.kron(rng.integers(0, 255, (30, 40, 3)), np.ones((8, 8, 1))).astype(np.uint8) for _ in range(3)]
    with pytest.raises(PoseError) as caught:
        estimate_poses(photos, work_dir=tmp_path / "work")
    assert "Only 0 of 3 photos could be placed; at least 2 are needed. What helps: more photos" in str(caught.value)
    assert (tmp_path / "work" / "database.db").is_file()


def test_masks_keep_keypoints_out(fern, tmp_path):
    for i in range(3):
        write_png(tmp_path / f"{i}.png", np.zeros((378, 504), np.uint8))
    with pytest.raises(PoseError, match="Only 0 of 3"):
        estimate_poses([fern.paths[i] for i in range(3)], masks=[tmp_path / f"{i}.png" for i in range(3)])


def test_one_photo_gets_a_stated_default_camera(tmp_path):
    write_png(tmp_path / "a.png", np.zeros((30, 40, 3), np.uint8))
    result = estimate_poses([tmp_path / "a.png"])
    assert result.cameras.intrinsics[0, 0, 0].item() == pytest.approx(20 / math.tan(math.radians(30)))
    assert torch.equal(result.cameras.world_from_camera[0], torch.eye(4, dtype=torch.float64))
    assert "60 degrees" in result.report.summary()
    spec = oiio.ImageSpec(40, 30, 3, "uint8")
    spec["Exif:FocalLengthIn35mmFilm"] = 28
    out = oiio.ImageOutput.create(str(tmp_path / "b.jpg"))
    out.open(str(tmp_path / "b.jpg"), spec)
    out.write_image(np.zeros((30, 40, 3), np.uint8))
    out.close()
    result = estimate_poses([tmp_path / "b.jpg"])
    assert result.cameras.intrinsics[0, 0, 0].item() == pytest.approx(28 / 36 * 40)
    assert "EXIF" in result.report.summary()


def test_bad_arguments_are_refused(tmp_path):
    with pytest.raises(InputError, match="no photos"):
        estimate_poses([])
    with pytest.raises(InputError, match="2 photos but 1 masks"):
        estimate_poses(["a", "b"], masks=[None])
    with pytest.raises(InputError, match="does not exist"):
        estimate_poses([tmp_path / "a.png", tmp_path / "b.png"])


def test_pairs_are_all_for_few_and_near_ones_for_many():
    assert image_pairs(4) == [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]
    many = image_pairs(300)
    assert len(many) == len(set(many)) < 300 * 16
    assert {(0, 1), (0, 10), (0, 64), (0, 256), (298, 299)} <= set(many)
    assert all(i < j < 300 for i, j in many)
