"""COLMAP models, binary and text (pycolmap), beside a folder of images; sparse points are kept."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from flows.errors import InputError
from flows.readers import splits
from flows.readers.base import Capture, inside
from flows.readers.parsing import cameras_for_files, family_of, from_camera_from_world, pinhole, unlisted_note
from flows.sfm.colmap import pycolmap

LOOKS_FOR = "sparse/0, sparse, or colmap/sparse/0 with cameras.bin or cameras.txt (COLMAP)"
MODEL_FOLDERS = ("sparse/0", "sparse", "colmap/sparse/0", ".")
IMAGE_FOLDERS = ("images", "input", "images_2", "images_4", "images_8", ".")
# COLMAP model -> where k1, k2, p1, p2, k3 lie in its parameters (None: zero). Focal lengths and centre come first.
DISTORTION = {
    "SIMPLE_PINHOLE": (None,) * 5,
    "PINHOLE": (None,) * 5,
    "SIMPLE_RADIAL": (3, None, None, None, None),
    "RADIAL": (3, 4, None, None, None),
    "OPENCV": (4, 5, 6, 7, None),
}


def detect(path: Path) -> bool:
    return path.is_dir() and _model_folder(path) is not None


def read(path: Path, image_folder: str | None, view_counts: tuple[int, ...]) -> Capture:
    """Registered images in sorted order of their names; those whose file is missing are reported and left out."""
    folder = _model_folder(path)
    if folder is None:
        raise InputError(
            f"{path} has no COLMAP model; looked for cameras.bin or cameras.txt in {', '.join(MODEL_FOLDERS)}."
        )
    model = load_model(folder)
    registered = sorted((im for im in model.images.values() if im.has_pose), key=lambda im: im.name)
    if not registered:
        raise InputError(f"The COLMAP model {folder} has no registered image.")
    folders = (image_folder,) if image_folder else IMAGE_FOLDERS
    counted = {f: sum(inside(path / f, im.name, folder).is_file() for im in registered) for f in folders}
    best = max(counted, key=lambda f: counted[f])  # the first of the fullest
    if not counted[best]:
        raise InputError(
            f"None of the {len(registered)} images of the COLMAP model {folder} (first: {registered[0].name}) is in "
            f"{path} / {', '.join(folders)}; put the images there."
        )
    present = [im for im in registered if inside(path / best, im.name, folder).is_file()]
    missing = [im.name for im in registered if im not in present]
    notes = [unlisted_note(len(missing), "registered images without a file were", missing)] if missing else []
    names = [im.name for im in present]
    paths = [path / best / name for name in names]
    used = [model.cameras[im.camera_id] for im in present]
    intrinsics, distortion = zip(*(intrinsics_of(c, folder) for c in used), strict=True)
    size = torch.tensor([[c.width, c.height] for c in used], dtype=torch.float64)
    poses = from_camera_from_world(torch.stack([camera_from_world(im) for im in present]))
    points = np.array([p.xyz for p in model.points3D.values()]).reshape(-1, 3)
    bent = torch.stack(distortion)
    return Capture(
        scene_id=path.resolve().name,
        dataset=family_of(path),
        names=names,
        paths=paths,
        cameras=cameras_for_files(torch.stack(intrinsics), size, poses, paths, names, folder, notes),
        distortion=bent if bent.any() else None,
        points=torch.as_tensor(points) if len(points) else None,
        splits=splits.every_8th(len(names), view_counts),
        missing=missing,
        notes=[*notes, splits.EVERY_8TH],
    )


def load_model(folder: Path) -> pycolmap.Reconstruction:
    """The model in `folder`. InputError when it is damaged or of a camera model pycolmap doesn't know."""
    kind = "bin" if (folder / "cameras.bin").is_file() else "txt"
    for part in ("cameras", "images", "points3D"):
        file = folder / f"{part}.{kind}"
        if not file.is_file():
            raise InputError(f"The COLMAP model {folder} has no {file.name}; copy the whole model.")
        if kind == "bin":
            _check_binary(file)
    try:
        return pycolmap.Reconstruction(str(folder))
    except Exception as error:  # pycolmap raises ValueError, RuntimeError or IndexError with its source line
        reason = str(error).strip().splitlines()[0].split("] ")[-1]
        raise InputError(
            f"The COLMAP model {folder} cannot be read ({reason}); copy it again or export it again."
        ) from None


def intrinsics_of(camera: pycolmap.Camera, source: Path | str) -> tuple[Tensor, Tensor]:
    """K (3, 3) in pixels and distortion (5) k1, k2, p1, p2, k3. InputError for a model that they can't express."""
    name = camera.model.name
    if name not in DISTORTION:
        raise InputError(
            f"{source}: camera model {name} is not supported ({', '.join(DISTORTION)} are); "
            "undistort the images with COLMAP's image_undistorter first."
        )
    k = [0.0 if i is None else float(camera.params[i]) for i in DISTORTION[name]]
    return (
        pinhole(camera.focal_length_x, camera.focal_length_y, camera.principal_point_x, camera.principal_point_y),
        torch.tensor(k, dtype=torch.float64),
    )


def camera_from_world(image: pycolmap.Image) -> Tensor:
    """(4, 4) float64, OpenCV axes."""
    out = torch.eye(4, dtype=torch.float64)
    out[:3] = torch.as_tensor(np.array(image.cam_from_world().matrix()))
    return out


def _model_folder(path: Path) -> Path | None:
    for folder in MODEL_FOLDERS:
        if any((path / folder / f"cameras.{kind}").is_file() for kind in ("bin", "txt")):
            return path / folder
    return None


def _check_binary(file: Path) -> None:
    """Refuse a binary file shorter than the count at its start allows (a native reader may loop or abort on it)."""
    smallest_record = {"cameras": 24 + 24, "images": 4 + 56 + 4 + 1 + 8, "points3D": 8 + 24 + 3 + 8 + 8}[file.stem]
    content = file.stat().st_size - 8
    with file.open("rb") as stream:
        count = int.from_bytes(stream.read(8), "little")
    if content < 0 or count * smallest_record > content:
        raise InputError(
            f"{file} is cut short: it announces {count} entries in {max(content, 0)} bytes; copy it again."
        )
