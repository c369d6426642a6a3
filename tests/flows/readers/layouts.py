"""Every layout of the readers, written to disk from known cameras and images: for table-driven tests."""

from __future__ import annotations

import gzip
import json
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pycolmap
import torch

from cat3d_core.cameras import Cameras
from flows.media.images import write_png

OPENGL = torch.diag(torch.tensor([1.0, -1, -1, 1], dtype=torch.float64))
Save = Callable[[Path, np.ndarray], None]
LAYOUTS: dict[str, Callable[..., Path]] = {}


def layout(write: Callable[..., Path]) -> Callable[..., Path]:
    """Register a writer: write(folder, cameras, images, names, save) -> the path to give to `read_capture`."""
    LAYOUTS[write.__name__] = write
    return write


def save_all(folder: Path, images: Sequence[np.ndarray], names: Sequence[str], save: Save) -> None:
    for name, image in zip(names, images, strict=True):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        save(folder / name, image)


def header(cameras: Cameras) -> dict[str, float]:
    k, (width, height) = cameras.intrinsics[0].tolist(), cameras.size[0].tolist()
    return {"w": width, "h": height, "fl_x": k[0][0], "fl_y": k[1][1], "cx": k[0][2], "cy": k[1][2]}


def frames(cameras: Cameras, names: Sequence[str], folder: str = "images/") -> list[dict]:
    poses = cameras.world_from_camera @ OPENGL
    return [{"file_path": f"{folder}{n}", "transform_matrix": p.tolist()} for n, p in zip(names, poses, strict=True)]


@layout
def transforms(folder: Path, cameras: Cameras, images, names, save: Save = write_png) -> Path:
    save_all(folder / "images", images, names, save)
    content = header(cameras) | {"frames": frames(cameras, names)}
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder


@layout
def transforms_per_frame(folder: Path, cameras: Cameras, images, names, save: Save = write_png) -> Path:
    save_all(folder / "images", images, names, save)
    entries = [header(cameras[i]) | f for i, f in enumerate(frames(cameras, names))]
    (folder / "transforms.json").write_text(json.dumps({"frames": entries}))
    return folder


@layout
def reconfusion(folder: Path, cameras: Cameras, images, names, save: Save = write_png) -> Path:
    transforms(folder, cameras, images, names, save)
    split = {"train_ids": [1, 2, 3], "test_ids": [0, 4]}
    (folder / "train_test_split_3.json").write_text(json.dumps(split))
    return folder


@layout
def nerf_synthetic(folder: Path, cameras: Cameras, images, names, save: Save = write_png) -> Path:
    save_all(folder / "train", images, names, save)
    content = header(cameras) | {"frames": frames(cameras, names, "./train/")}
    (folder / "transforms_train.json").write_text(json.dumps(content))
    return folder


def model(cameras: Cameras, names: Sequence[str], camera_model: str = "PINHOLE") -> pycolmap.Reconstruction:
    out = pycolmap.Reconstruction()
    width, height = cameras.size[0].tolist()
    k = cameras.intrinsics[0]
    params = [float(k[0, 0]), float(k[1, 1]), float(k[0, 2]), float(k[1, 2])]
    out.add_camera_with_trivial_rig(
        pycolmap.Camera(model=camera_model, width=width, height=height, params=params, camera_id=1)
    )
    for i, (name, view) in enumerate(zip(names, cameras.camera_from_world, strict=True)):
        image = pycolmap.Image(name=name, camera_id=1, image_id=i + 1)
        out.add_image_with_trivial_frame(image, pycolmap.Rigid3d(view[:3].numpy()))
    return out


@layout
def colmap_binary(folder: Path, cameras: Cameras, images, names, save: Save = write_png) -> Path:
    save_all(folder / "images", images, names, save)
    (folder / "sparse" / "0").mkdir(parents=True)
    model(cameras, names).write_binary(str(folder / "sparse" / "0"))
    return folder


@layout
def colmap_text(folder: Path, cameras: Cameras, images, names, save: Save = write_png) -> Path:
    save_all(folder / "images", images, names, save)
    (folder / "sparse" / "0").mkdir(parents=True)
    model(cameras, names).write_text(str(folder / "sparse" / "0"))
    return folder


@layout
def llff(folder: Path, cameras: Cameras, images, names, save: Save = write_png) -> Path:
    save_all(folder / "images", images, names, save)
    (width, height), focal = cameras.size[0].tolist(), float(cameras.intrinsics[0, 0, 0])
    rows = []
    for pose in cameras.world_from_camera.numpy():
        right, down, forward, center = pose[:3].T
        columns = np.stack([down, right, -forward, center, np.array([height, width, focal])], -1)
        rows.append([*columns.ravel(), 1.5, 9.0])
    np.save(folder / "poses_bounds.npy", np.array(rows))
    return folder


@layout
def dtu(folder: Path, cameras: Cameras, images, names, save: Save = write_png) -> Path:
    save_all(folder / "image", images, names, save)
    arrays = {}
    for i, (k, view) in enumerate(zip(cameras.intrinsics, cameras.camera_from_world, strict=True)):
        arrays[f"world_mat_{i}"] = np.eye(4)
        arrays[f"world_mat_{i}"][:3] = (k @ view[:3]).numpy()
    np.savez(folder / "cameras_sphere.npz", **arrays)
    return folder


def _pytorch3d(cameras: Cameras) -> tuple[torch.Tensor, torch.Tensor]:
    flip = torch.diag(torch.tensor([-1.0, -1, 1], dtype=torch.float64))
    view = cameras.camera_from_world
    return (flip @ view[:, :3, :3]).transpose(1, 2), view[:, :3, 3] @ flip


@layout
def co3d_poses(folder: Path, cameras: Cameras, images, names, save: Save = write_png) -> Path:
    """Principal point in the middle: the layout has no other."""
    save_all(folder / "images", images, names, save)
    rotation, translation = _pytorch3d(cameras)
    focal = cameras.intrinsics[:, [0, 1], [0, 1]] / (cameras.size.min(1).values[:, None] / 2)
    np.savez(folder / "gt_cameras.npz", gtR=rotation, gtT=translation, gtFL=focal)
    return folder


@layout
def co3d(folder: Path, cameras: Cameras, images, names, save: Save = write_png) -> Path:
    sequence = folder / "apple" / "110_1_2"
    save_all(sequence / "images", images, names, save)
    rotation, translation = _pytorch3d(cameras)
    entries = []
    for i, name in enumerate(names):
        size, k = cameras.size[i].double(), cameras.intrinsics[i]
        view = {
            "R": rotation[i].tolist(),
            "T": translation[i].tolist(),
            "focal_length": (k[[0, 1], [0, 1]] / (size / 2)).tolist(),
            "principal_point": ((size / 2 - k[:2, 2]) / (size / 2)).tolist(),
            "intrinsics_format": "ndc_norm_image_bounds",
        }
        image = {"path": f"apple/110_1_2/images/{name}", "size": cameras.size[i].tolist()[::-1]}
        entries.append({"sequence_name": "110_1_2", "frame_number": i, "image": image, "viewpoint": view})
    (folder / "apple" / "frame_annotations.jgz").write_bytes(gzip.compress(json.dumps(entries).encode()))
    return sequence


@layout
def realestate10k(folder: Path, cameras: Cameras, images, names, save: Save = write_png) -> Path:
    """Names are times: those given are taken where they are numbers."""
    extension = Path(names[0]).suffix
    times = [1000000 + 33366 * i for i in range(len(names))]
    save_all(folder / "frames", images, [f"{t}{extension}" for t in times], save)
    lines = ["https://www.youtube.com/watch?v=none"]
    for i, t in enumerate(times):
        k, (w, h) = cameras.intrinsics[i], cameras.size[i].tolist()
        row = [t, k[0, 0] / w, k[1, 1] / h, k[0, 2] / w, k[1, 2] / h, 0, 0, *cameras.camera_from_world[i, :3].ravel()]
        lines.append(" ".join(str(float(x)) if j else str(x) for j, x in enumerate(row)))
    (folder / "0123456789abcdef.txt").write_text("\n".join(lines))
    return folder


@layout
def strecha(folder: Path, cameras: Cameras, images, names, save: Save = write_png) -> Path:
    save_all(folder / "images", images, names, save)
    (folder / "gt_dense_cameras").mkdir()
    for i, name in enumerate(names):
        pose, size = cameras.world_from_camera[i], cameras.size[i].tolist()
        rows = [*cameras.intrinsics[i].tolist(), [0, 0, 0], *pose[:3, :3].tolist(), pose[:3, 3].tolist(), size]
        text = "\n".join(" ".join(map(str, row)) for row in rows)
        (folder / "gt_dense_cameras" / f"{name}.camera").write_text(text)
    return folder


def photos(folder: Path, cameras: Cameras, images, names, save: Save = write_png) -> Path:
    """No cameras are written."""
    save_all(folder, images, names, save)
    return folder


# Layouts whose files say the names of the images; the others go by order or by numbers.
NAMED = ("transforms", "transforms_per_frame", "nerf_synthetic", "colmap_binary", "colmap_text", "co3d", "strecha")
