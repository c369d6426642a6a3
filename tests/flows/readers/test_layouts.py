"""Each layout, written from known cameras by its published definition, reads back as cameras that project alike."""

from __future__ import annotations

import gzip
import json
import math
import re
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import torch

from flows.errors import InputError
from flows.readers import read_capture
from flows.readers.dtu import decompose_projection
from flows.readers.splits import every_8th, linspace_ids

OPENGL = torch.diag(torch.tensor([1.0, -1, -1, 1], dtype=torch.float64))


def _same_projection(capture, truth, points, tolerance=1e-6):
    torch.testing.assert_close(capture.cameras.project(points)[0], truth.project(points)[0], atol=tolerance, rtol=0)


def _header(truth, scale=1.0):
    k = truth.intrinsics[0] * scale
    keys = {"fl_x": k[0, 0], "fl_y": k[1, 1], "cx": k[0, 2], "cy": k[1, 2], "w": 64 * scale, "h": 48 * scale}
    return {key: float(value) for key, value in keys.items()}


def _frames(truth, names):
    return [
        {"file_path": f"images/{n}", "transform_matrix": (p @ OPENGL).tolist()}
        for n, p in zip(names, truth.world_from_camera, strict=True)
    ]


def _write(path: Path, content) -> None:
    path.write_text(json.dumps(content))


def test_transforms_global_intrinsics_at_another_size_and_distortion(tmp_path, truth, points, write_images):
    names = write_images(tmp_path / "images", 10)
    lens = {"k1": 0.1, "k2": -0.2, "p1": 0.01, "p2": 0.02, "k3": 0.3}
    _write(tmp_path / "transforms.json", _header(truth, 2.0) | lens | {"frames": _frames(truth, names)[::-1]})
    capture = read_capture(tmp_path)
    assert capture.names == [f"images/{n}" for n in names]
    _same_projection(capture, truth, points)
    assert capture.distortion is not None
    assert capture.distortion[3].tolist() == [0.1, -0.2, 0.01, 0.02, 0.3]
    assert any("scaled from 128 x 96" in n for n in capture.notes)


def test_transforms_per_frame_intrinsics_and_mixed_sizes(tmp_path, truth, points, write_images):
    names = write_images(tmp_path / "images", 9)
    write_images(tmp_path / "images", 1, 128, 96, ["009.png"])
    frames = _frames(truth, [*names, "009.png"])
    for i, frame in enumerate(frames):
        frame |= _header(truth, 2.0 if i == 9 else 1.0)
    _write(tmp_path / "transforms.json", {"frames": frames})
    capture = read_capture(tmp_path)
    assert capture.cameras.size[9].tolist() == [128, 96]
    pixels = capture.cameras.project(points)[0]
    expected = truth.project(points)[0]
    torch.testing.assert_close(pixels[:9], expected[:9], atol=1e-6, rtol=0)
    torch.testing.assert_close(pixels[9], 2 * expected[9], atol=1e-6, rtol=0)


def test_transforms_applied_transform_is_undone(tmp_path, truth, points, write_images):
    names = write_images(tmp_path / "images", 10)
    applied = torch.tensor([[1.0, 0, 0, 0.5], [0, 0, 1, 0], [0, -1, 0, 2], [0, 0, 0, 1]], dtype=torch.float64)
    frames = _frames(truth, names)
    for frame in frames:
        frame["transform_matrix"] = (applied @ torch.tensor(frame["transform_matrix"], dtype=torch.float64)).tolist()
    _write(tmp_path / "transforms.json", _header(truth) | {"applied_transform": applied[:3].tolist(), "frames": frames})
    _same_projection(read_capture(tmp_path), truth, points)


def test_transforms_reports_and_leaves_out_missing_frames(tmp_path, truth, points, write_images):
    names = write_images(tmp_path / "images", 10)
    _write(tmp_path / "transforms.json", _header(truth) | {"frames": _frames(truth, names)})
    (tmp_path / "images" / "004.png").unlink()
    capture = read_capture(tmp_path)
    assert capture.missing == ["images/004.png"]
    assert len(capture) == 9
    assert "1 frames whose image is missing" in capture.notes[0]
    keep = [i for i in range(10) if i != 4]
    _same_projection(capture, truth[keep], points)


def test_nerf_synthetic_pairs_of_files_without_extensions(tmp_path, write_images):
    for part, count in (("train", 5), ("test", 2)):
        write_images(tmp_path / part, count, 40, 40, [f"r_{i}.png" for i in range(count)])
        frames = [{"file_path": f"./{part}/r_{i}", "transform_matrix": np.eye(4).tolist()} for i in range(count)]
        _write(tmp_path / f"transforms_{part}.json", {"camera_angle_x": math.radians(60), "frames": frames})
    capture = read_capture(tmp_path)
    assert capture.dataset == "nerf_synthetic"
    assert capture.splits["3"] == {"train": [0, 2, 4], "test": [5, 6]}
    assert capture.cameras.intrinsics[0, 0, 0] == pytest.approx(20 / math.tan(math.radians(30)))


def test_reconfusion_splits_follow_the_order_of_the_file(tmp_path, truth, write_images):
    names = write_images(tmp_path / "images", 10)
    _write(tmp_path / "transforms.json", _header(truth) | {"frames": _frames(truth, names)[::-1]})
    _write(tmp_path / "train_test_split_3.json", {"train_ids": [0, 1, 2], "test_ids": [9, 8]})
    capture = read_capture(tmp_path)
    # Frame 0 of the reversed file is the last by name.
    assert capture.splits["3"] == {"train": [9, 8, 7], "test": [0, 1]}
    assert capture.splits["all"]["train"] == [2, 3, 4, 5, 6, 7, 8, 9]
    (tmp_path / "images" / "008.png").unlink()
    capture = read_capture(tmp_path)
    assert capture.splits["3"]["train"] == [8, 7]
    assert any("1 train views have no image" in n for n in capture.notes)


@pytest.mark.parametrize("kind", ["binary", "text"])
def test_colmap_models(tmp_path, truth, points, write_images, kind):
    names = write_images(tmp_path / "images", 10)
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(
        model="OPENCV", width=64, height=48, params=[70, 71, 33, 23, 0.1, 0.01, 0.001, 0.002], camera_id=1
    )
    model.add_camera_with_trivial_rig(camera)
    view = truth.camera_from_world
    for i in reversed(range(10)):
        image = pycolmap.Image(name=names[i], camera_id=1, image_id=i + 1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(view[i, :3].numpy()))
    for point in points.numpy():
        model.add_point3D(point, pycolmap.Track(), np.zeros(3, np.uint8))
    folder = tmp_path / "sparse" / "0"
    folder.mkdir(parents=True)
    (model.write_binary if kind == "binary" else model.write_text)(str(folder))
    capture = read_capture(tmp_path)
    assert capture.names == names
    _same_projection(capture, truth, points)
    assert capture.distortion[0].tolist() == [0.1, 0.01, 0.001, 0.002, 0]
    np.testing.assert_allclose(np.sort(capture.points, 0), np.sort(points, 0), atol=1e-12)


def test_llff(tmp_path, truth, points, write_images):
    names = write_images(tmp_path / "images_8", 10)
    rows = []
    for pose in truth.world_from_camera.numpy():
        right, down, forward, center = pose[:3].T
        hwf = np.array([48 * 8, 64 * 8, 70 * 8.0])
        rows.append([*np.stack([down, right, -forward, center, hwf], -1).ravel(), 1.5, 9.0])
    np.save(tmp_path / "poses_bounds.npy", np.array(rows))
    capture = read_capture(tmp_path)
    assert capture.names == names
    centered = truth.intrinsics.clone()
    centered[:] = torch.tensor([[70.0, 0, 32], [0, 70, 24], [0, 0, 1]])
    _same_projection(capture, type(truth)(centered, truth.world_from_camera, truth.size), points)
    assert capture.depth_bounds[0].tolist() == [1.5, 9.0]


def test_dtu_layout_at_the_files_own_size(tmp_path, truth, points, write_images):
    write_images(tmp_path / "image", 10)
    write_images(tmp_path / "mask", 10)
    view = truth.camera_from_world
    scale = np.diag([2.0, 2, 2, 1])
    scale[:3, 3] = [0, 0, 8]
    arrays = {}
    for i in range(10):
        p = np.eye(4)
        p[:3] = (truth.intrinsics[i] @ view[i, :3]).numpy() * (-3.0 if i % 2 else 0.5)  # any scale and sign
        arrays |= {f"world_mat_{i}": p, f"scale_mat_{i}": scale}
    np.savez(tmp_path / "cameras_sphere.npz", **arrays)
    capture = read_capture(tmp_path)
    _same_projection(capture, truth, points)
    assert len(capture.masks) == 10
    depth = view[0] @ torch.tensor([0.0, 0, 8, 1], dtype=torch.float64)
    assert capture.depth_bounds[0].tolist() == pytest.approx([float(depth[2]) - 2, float(depth[2]) + 2])


def test_decompose_projection_recovers_k_and_pose(truth):
    projection = truth.intrinsics @ truth.camera_from_world[:, :3]
    k, pose = decompose_projection(-7.5 * projection)
    torch.testing.assert_close(k, truth.intrinsics, atol=1e-9, rtol=0)
    torch.testing.assert_close(pose, truth.world_from_camera, atol=1e-9, rtol=0)


def _pytorch3d(truth):
    """R, T with row vectors and x left, y up."""
    flip = torch.diag(torch.tensor([-1.0, -1, 1], dtype=torch.float64))
    view = truth.camera_from_world
    return (flip @ view[:, :3, :3]).transpose(1, 2), view[:, :3, 3] @ flip


def test_co3d_official_annotations(tmp_path, truth, points, write_images):
    sequence = tmp_path / "apple" / "110_1_2"
    names = write_images(sequence / "images", 10, names=[f"frame{i:06d}.png" for i in range(10)])
    rotation, translation = _pytorch3d(truth)
    frames = []
    for i, name in enumerate(names):
        isotropic = i % 2 == 0
        half = np.array([24.0, 24.0]) if isotropic else np.array([32.0, 24.0])
        view = {
            "R": rotation[i].tolist(),
            "T": translation[i].tolist(),
            "focal_length": (np.array([70, 71]) / half).tolist(),
            "principal_point": ((np.array([32, 24]) - np.array([33, 23])) / half).tolist(),
            "intrinsics_format": "ndc_isotropic" if isotropic else "ndc_norm_image_bounds",
        }
        image = {"path": f"apple/110_1_2/images/{name}", "size": [48, 64]}
        frames.append({"sequence_name": "110_1_2", "frame_number": i, "image": image, "viewpoint": view, "mask": None})
    frames.append(frames[0] | {"sequence_name": "other"})
    (tmp_path / "apple" / "frame_annotations.jgz").write_bytes(gzip.compress(json.dumps(frames).encode()))
    capture = read_capture(sequence)
    assert capture.scene_id == "apple_110_1_2"
    assert capture.dataset == "co3d"
    _same_projection(capture, truth, points)


def test_realestate10k_camera_list(tmp_path, truth, points, write_images):
    times = [1000000 + 33366 * i for i in range(10)]
    write_images(tmp_path / "frames", 10, names=[f"{t}.png" for t in times])
    lines = ["https://www.youtube.com/watch?v=none"]
    for t, view in zip(times, truth.camera_from_world, strict=True):
        numbers = [t, 70 / 64, 71 / 48, 33 / 64, 23 / 48, 0, 0, *view[:3].ravel().tolist()]
        lines.append(" ".join(str(n) for n in numbers))
    lines.append(lines[-1].replace(str(times[-1]), "9999999"))
    (tmp_path / "0123456789abcdef.txt").write_text("\n".join(lines))
    capture = read_capture(tmp_path)
    assert capture.dataset == "realestate10k"
    assert capture.missing == ["9999999"]
    _same_projection(capture, truth, points)


def test_strecha(tmp_path, truth, points, write_images):
    names = write_images(tmp_path / "images", 10)
    (tmp_path / "gt_dense_cameras").mkdir()
    for name, k, pose in zip(names, truth.intrinsics, truth.world_from_camera, strict=True):
        doubled = k * torch.tensor([[2.0], [2], [1]])
        rows = [*doubled.tolist(), [0, 0, 0], *pose[:3, :3].tolist(), pose[:3, 3].tolist(), [128, 96]]
        (tmp_path / "gt_dense_cameras" / f"{name}.camera").write_text("\n".join(" ".join(map(str, r)) for r in rows))
    capture = read_capture(tmp_path)
    _same_projection(capture, truth, points)
    assert capture.splits["all"]["test"] == [3, 7]


def test_plain_photos_and_one_photo(tmp_path, write_images):
    write_images(tmp_path / "images", 9)
    capture = read_capture(tmp_path)
    assert capture.cameras is None
    assert capture.splits["3"] == {"train": [1, 4, 7], "test": [0, 8]}
    one = read_capture(tmp_path / "images" / "003.png")
    assert one.names == ["003.png"]
    assert one.splits["all"] == {"train": [0], "test": []}


def test_procedural_images_match_their_cameras():
    capture = read_capture("procedural:dtu/2?views=4&width=24&height=16")
    assert [i.shape for i in capture.images] == [(16, 24, 3)] * 4
    assert capture.cameras.size.tolist() == [[24, 16]] * 4
    again = read_capture("procedural:dtu/2?views=4&width=24&height=16")
    assert all(np.array_equal(a, b) for a, b in zip(capture.images, again.images, strict=True))
    assert capture.images[1:3][0] is capture.images[1]
    assert [d.shape for d in capture.depths] == [(16, 24)] * 4


def test_procedural_views_are_known_without_rendering_them(monkeypatch):
    from flows.jobs.scene import capture_digests

    monkeypatch.setattr("flows.readers.procedural.trace", None)
    one, other = (read_capture(f"procedural:dtu/{seed}?views=4&width=24&height=16") for seed in (51, 52))
    digests = [*capture_digests(one)["images"].values(), *capture_digests(other)["images"].values()]
    assert len(set(digests)) == 8
    assert all(re.fullmatch("[0-9a-f]{64}", digest) for digest in digests)


def test_linspace_rule_matches_the_published_llff_splits(shared_data):
    published = json.loads((shared_data / "splits" / "llff_regnerf.json").read_text())["scenes"]
    for scene in published.values():
        ours = every_8th(scene["n"], (3, 6, 9))
        for count in (3, 6, 9):
            assert ours[str(count)] == {"train": scene[f"train_{count}"], "test": scene["test"]}


def test_dtu_splits_match_the_published_ones(shared_data):
    published = json.loads((shared_data / "splits" / "dtu_pixelnerf.json").read_text())
    splits = read_capture(shared_data / "dtu_scan24").splits
    for count in (3, 6, 9):
        assert splits[str(count)] == {"train": published[f"train_{count}"], "test": published["test"]}


def test_linspace_ids_takes_both_ends():
    assert linspace_ids(range(100), 1) == [0]
    assert linspace_ids(range(100), 2) == [0, 99]
    assert linspace_ids([5, 6, 7], 3) == [5, 6, 7]


def test_named_reader_is_used_and_an_unknown_one_is_refused(tmp_path, write_images):
    write_images(tmp_path, 2)
    assert read_capture(tmp_path, reader="photos").dataset == "photos"
    with pytest.raises(InputError, match='no reader "foo"'):
        read_capture(tmp_path, reader="foo")
