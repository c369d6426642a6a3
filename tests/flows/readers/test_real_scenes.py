"""The readers' cameras on real photographs: SIFT matches must lie on their epipolar lines.

The images are read, undistorted and resized by `flows.media.images`, and the cameras changed along, so a wrong axis,
a wrong scale of K, a half-applied distortion or a wrong resize all show as pixels here.
"""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest
import torch

from cat3d_core.cameras import Cameras
from flows.media.images import read_image, resize, undistort
from flows.readers import read_capture

LONG_SIDE = 800
# Scene, reader, two views that overlap, and the bound on the median Sampson distance in pixels at LONG_SIDE.
SCENES = [
    ("llff_fern", "llff", (0, 1), 0.5),
    ("llff_flower", "llff", (0, 1), 0.5),
    ("dtu_scan24", "dtu", (0, 1), 0.5),
    ("dtu_scan37", "dtu", (22, 23), 0.5),
    ("co3d_apple", "co3d", (0, 1), 0.7),
    ("re10k_bedroom", "colmap", (0, 5), 0.7),
    ("re10k_bedroom", "transforms", (0, 5), 0.7),
    ("mipnerf360_bonsai", "colmap", (100, 102), 0.5),
    ("mipnerf360_bonsai", "transforms", (100, 102), 0.5),
    ("fox", "transforms", (1, 2), 0.7),
    ("strecha_fountain_P11", "strecha", (4, 5), 0.3),
    ("nerf_synthetic_lego", "transforms", (32, 33), 0.6),
]


def _prepared(capture, view: int) -> tuple[np.ndarray, Cameras]:
    image, _ = read_image(capture.paths[view])
    camera = capture.cameras[view]
    if capture.distortion is not None:
        image, k = undistort(image, camera.intrinsics[0], capture.distortion[view])
        camera = Cameras(k[None], camera.world_from_camera, camera.size)
    scale = min(1.0, LONG_SIDE / max(image.shape[:2]))
    height, width = (round(s * scale) for s in image.shape[:2])
    return resize(image, width, height), camera.resize(width, height)


def _matches(a: np.ndarray, b: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
    """Pixel positions (M, 2) in both, by mutual nearest SIFT neighbours with a ratio test."""
    options = pycolmap.FeatureExtractionOptions()
    options.sift.max_num_features = 3000
    sift = pycolmap.Sift(options, pycolmap.Device.cpu)
    (xa, da), (xb, db) = (sift.extract(i.astype(np.float32).mean(-1) / 255) for i in (a, b))
    da, db = torch.tensor(da).float(), torch.tensor(db).float()
    da, db = da / da.norm(dim=1, keepdim=True), db / db.norm(dim=1, keepdim=True)
    distance = (2 - 2 * da @ db.T).clamp(min=0).sqrt()
    two, nearest = distance.topk(2, largest=False)
    mutual = distance.argmin(0)[nearest[:, 0]] == torch.arange(len(da))
    keep = mutual & (two[:, 0] < 0.7 * two[:, 1])
    return torch.tensor(xa[:, :2])[keep].double(), torch.tensor(xb[:, :2])[nearest[keep, 0]].double()


def _sampson(a: Cameras, b: Cameras, xa: torch.Tensor, xb: torch.Tensor) -> torch.Tensor:
    """First-order distance in pixels of the matches from the epipolar geometry (Hartley and Zisserman 11.9)."""
    relative = (b.camera_from_world @ a.world_from_camera)[0]
    t = relative[:3, 3]
    cross = torch.tensor([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
    f = torch.linalg.inv(b.intrinsics[0]).T @ cross @ relative[:3, :3] @ torch.linalg.inv(a.intrinsics[0])
    one = torch.ones(len(xa), 1, dtype=torch.float64)
    ha, hb = torch.cat([xa, one], 1), torch.cat([xb, one], 1)
    la, lb = ha @ f.T, hb @ f
    norm = la[:, :2].square().sum(1) + lb[:, :2].square().sum(1)
    return (hb * la).sum(1).abs() / norm.sqrt()


@pytest.mark.parametrize(("scene", "reader", "views", "bound_px"), SCENES, ids=lambda v: str(v))
def test_matches_lie_on_epipolar_lines(shared_data, scene, reader, views, bound_px):
    capture = read_capture(shared_data / scene, reader=reader)
    (image_a, a), (image_b, b) = (_prepared(capture, v) for v in views)
    xa, xb = _matches(image_a, image_b)
    assert len(xa) > 40
    error = _sampson(a, b, xa, xb).median()
    assert error < bound_px
    # The same matches contradict a wrong camera: another view's pose in place of b's.
    wrong = capture.cameras[(views[1] + 3) % len(capture)]
    assert _sampson(a, Cameras(b.intrinsics, wrong.world_from_camera, b.size), xa, xb).median() > 3 * error


def test_shipped_points_of_the_colmap_scenes_are_seen(shared_data):
    for scene in ("re10k_bedroom", "mipnerf360_bonsai"):
        capture = read_capture(shared_data / scene, reader="colmap")
        pixels, depth = capture.cameras.project(capture.points)
        size = capture.cameras.size[:, None].double()
        seen = (depth > 0) & (pixels > 0).all(-1) & (pixels < size).all(-1)
        assert (seen.sum(0) >= 2).double().mean() > 0.99


def test_detection_chooses_the_layout_of_each_scene(shared_data):
    expected = {
        "fox": ("capture", 50),
        "llff_fern": ("llff", 20),
        "dtu_scan24": ("dtu", 49),
        "co3d_apple": ("co3d", 20),
        "re10k_bedroom": ("realestate10k", 25),
        "mipnerf360_bonsai": ("mipnerf360", 292),
        "strecha_fountain_P11": ("strecha", 11),
        "nerf_synthetic_lego": ("nerf_synthetic", 57),
        "photo_pool": ("photos", 37),
    }
    for scene, (family, count) in expected.items():
        capture = read_capture(shared_data / scene)
        assert (capture.dataset, len(capture)) == (family, count)
    assert len(read_capture(shared_data / "fox").missing) == 17


def test_fox_and_flower_agree_with_their_stated_sizes(shared_data):
    fox = read_capture(shared_data / "fox")
    assert fox.cameras.intrinsics[0, 0, 0].item() == pytest.approx(1375.52 * 567 / 1080)
    assert fox.cameras.intrinsics[0, 1, 2].item() == pytest.approx(965.268 * 1008 / 1920)
    assert read_capture(shared_data / "dtu_scan24").masks[0].name == "000.png"
