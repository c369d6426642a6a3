"""Strecha et al. (CVPR 2008): one text file NAME.camera per image, with laser-scanned ground truth.

Rows: K (3), a row of zeros, R camera-to-world (3), the camera's centre in metres, and the calibrated width and height.
OpenCV axes, no distortion.
"""

from __future__ import annotations

from pathlib import Path

import torch

from flows.errors import InputError
from flows.readers import splits
from flows.readers.base import Capture
from flows.readers.parsing import cameras_for_files, images_in, numbers, read_text_table, unlisted_note

LOOKS_FOR = "*.camera files, one per image (Strecha)"
CAMERA_FOLDERS = ("gt_dense_cameras", "cameras", ".")
TEST_VIEWS = (3, 7)


def detect(path: Path) -> bool:
    return path.is_dir() and _camera_folder(path) is not None


def read(path: Path, image_folder: str | None, view_counts: tuple[int, ...]) -> Capture:
    """Images with a camera file, sorted. Views 3 and 7 are held out."""
    folder = _camera_folder(path)
    if folder is None:
        raise InputError(f"{path} has no *.camera files; it is not a Strecha scene.")
    images = images_in(path / (image_folder or ("images" if (path / "images").is_dir() else ".")), path)
    by_stem = {Path(p.name.removesuffix(".camera")).stem: p for p in folder.glob("*.camera")}
    paths = [p for p in images if p.stem in by_stem]
    without = [p.name for p in images if p.stem not in by_stem]
    if not paths:
        raise InputError(f"No image of {path} has a camera file in {folder} (the file 0000.jpg has 0000.jpg.camera).")
    names = [p.name for p in paths]
    missing = sorted(by_stem.keys() - {p.stem for p in images})
    notes = [unlisted_note(len(missing), "cameras without an image were", missing)] if missing else []
    if without:
        notes.append(unlisted_note(len(without), "images without a camera file were", without))
    read_all = [_read_camera(by_stem[p.stem]) for p in paths]
    intrinsics, poses, size = (torch.stack(part) for part in zip(*read_all, strict=True))
    test = [i for i in TEST_VIEWS if i < len(paths)] if len(paths) >= 4 else []
    notes.append("Split rule: views 3 and 7 are test views; training views are a rounded linspace over the rest.")
    placed = cameras_for_files(intrinsics, size, poses, paths, names, folder, notes)
    return Capture(
        scene_id=path.resolve().name,
        dataset="strecha",
        names=names,
        paths=paths,
        cameras=placed.cameras,
        upright=placed.upright,
        splits=splits.held_out(len(paths), test, view_counts),
        missing=missing,
        notes=notes,
    )


def _read_camera(file: Path) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """K (3, 3), world_from_camera (4, 4), [width, height]."""
    rows = read_text_table(file)
    if [len(r) for r in rows] != [3] * 8 + [2]:
        raise InputError(f"{file} does not have the 9 rows of a Strecha camera (K, zeros, R, centre, width height).")
    table = numbers(rows[:8], (8, 3), "camera", file)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3], pose[:3, 3] = table[4:7], table[7]
    return table[:3], pose, torch.tensor(rows[8], dtype=torch.float64)


def _camera_folder(path: Path) -> Path | None:
    return next((path / f for f in CAMERA_FOLDERS if (path / f).is_dir() and any((path / f).glob("*.camera"))), None)
