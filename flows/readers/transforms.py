"""nerfstudio and instant-ngp: transforms.json; NeRF's synthetic scenes: transforms_train.json and _test.json.

camera-to-world matrices with OpenGL camera axes; intrinsics global or per frame, in pixels of w x h or as
camera_angle_x (radians); OpenCV distortion k1 k2 p1 p2 k3. nerfstudio writes the poses with `applied_transform` already
applied; it is undone here, so that the world is that of the original reconstruction.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from flows.errors import InputError
from flows.media.images import EXTENSIONS, image_size
from flows.readers import splits
from flows.readers.base import Capture, inside
from flows.readers.parsing import (
    cameras_for_files,
    family_of,
    from_opengl,
    load_json,
    numbers,
    pinhole,
    unlisted_note,
)

LOOKS_FOR = "transforms.json, or transforms_train.json (NeRF synthetic)"
SYNTHETIC_PARTS = ("train", "val", "test")
MODELS = frozenset({"OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE"})


@dataclass
class Frame:
    """One frame of a transforms.json whose image exists. `json_id` is its place in the file's list."""

    json_id: int
    name: str
    path: Path
    entry: dict[str, Any]
    header: dict[str, Any]
    source: Path


def detect(path: Path) -> bool:
    return (path / "transforms.json").is_file() or (path / "transforms_train.json").is_file()


def read(path: Path, image_folder: str | None, view_counts: tuple[int, ...]) -> Capture:
    """Frames in sorted order of file_path; those without an image are reported and left out."""
    if (path / "transforms.json").is_file():
        frames, missing = load_frames(path, "transforms.json", image_folder)
        capture = to_capture(path, frames, missing)
        capture.splits = splits.every_8th(len(frames), view_counts)
        capture.notes.append(splits.EVERY_8TH)
        return capture
    parts = [p for p in SYNTHETIC_PARTS if (path / f"transforms_{p}.json").is_file()]
    if "train" not in parts:
        raise InputError(f"{path} has neither transforms.json nor transforms_train.json.")
    return _read_synthetic(path, parts, view_counts)


def load_frames(root: Path, file_name: str, image_folder: str | None = None) -> tuple[list[Frame], list[str]]:
    """(frames whose image exists, sorted by name; names of the missing). InputError for a malformed file."""
    source = root / file_name
    header = load_json(source)
    entries = header.get("frames") if isinstance(header, dict) else None
    if not isinstance(entries, list) or not entries:
        raise InputError(f'{source} has no list "frames"; it is not a transforms.json, or has no views.')
    frames, missing = [], []
    for i, entry in enumerate(entries):
        if not isinstance(entry, dict) or not isinstance(entry.get("file_path"), str):
            raise InputError(f'{source}: frame {i} has no "file_path".')
        name = str(Path(entry["file_path"]))
        if image_folder:
            name = str(Path(image_folder) / Path(name).name)
        found = _image_file(root, name, source)
        if found is None:
            missing.append(name)
        else:
            frames.append(Frame(i, name, found, entry, header, source))
    if not frames:
        raise InputError(
            f"{source} lists {len(entries)} frames, but none of their images exists (first: {missing[0]})."
        )
    return sorted(frames, key=lambda f: f.name), missing


def to_capture(path: Path, frames: list[Frame], missing: list[str]) -> Capture:
    """Cameras and distortion of the frames, without splits."""
    notes = [unlisted_note(len(missing), "frames whose image is missing were", missing)] if missing else []
    names = [f.name for f in frames]
    poses = torch.stack([_pose(f) for f in frames])
    sizes = torch.stack([_calibrated_size(f) for f in frames])
    intrinsics = torch.stack([_intrinsics(f, size) for f, size in zip(frames, sizes, strict=True)])
    distortion = torch.stack([_distortion(f) for f in frames])
    source = frames[0].source
    return Capture(
        scene_id=path.resolve().name,
        dataset=family_of(path),
        names=names,
        paths=[f.path for f in frames],
        cameras=cameras_for_files(
            intrinsics, sizes, from_opengl(poses), [f.path for f in frames], names, source, notes
        ),
        distortion=distortion if distortion.any() else None,
        missing=missing,
        notes=notes,
    )


def _read_synthetic(path: Path, parts: list[str], view_counts: tuple[int, ...]) -> Capture:
    frames, missing, roles = [], [], []
    for part in parts:
        try:
            found, lost = load_frames(path, f"transforms_{part}.json")
        except InputError as error:
            if part == "train" or "none of their images" not in str(error):
                raise
            continue
        found.sort(key=lambda f: f.json_id)  # r_0, r_1, ... r_10: the file's order is the numbers' order
        frames += found
        missing += lost
        roles += [part] * len(found)
    capture = to_capture(path, frames, missing)
    capture.dataset = "nerf_synthetic"
    train = [i for i, role in enumerate(roles) if role == "train"]
    test = [i for i, role in enumerate(roles) if role == "test"]
    few = {str(k): splits.linspace_ids(train, k) for k in view_counts if k <= len(train)}
    capture.splits = {name: {"train": ids, "test": test} for name, ids in (few | {"all": train}).items()}
    capture.notes.append(
        "Split rule: test views are those of transforms_test.json, training views a rounded linspace over the others."
    )
    return capture


def _image_file(root: Path, name: str, source: Path) -> Path | None:
    """The file itself, or with an extension added where the JSON leaves it out (NeRF synthetic)."""
    target = inside(root, name, source)
    if target.is_file():
        return target
    candidates = (target.with_name(f"{target.name}.{e}") for e in ("png", "jpg", *sorted(EXTENSIONS)))
    return next((inside(root, str(c.relative_to(root)), source) for c in candidates if c.is_file()), None)


def _value(frame: Frame, key: str) -> float | None:
    """A number of the frame, else of the file's header."""
    value = frame.entry.get(key, frame.header.get(key))
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise InputError(f'{frame.source}: "{key}" of {frame.name} is {value!r}; expected a number.')
    return float(value)


def _pose(frame: Frame) -> Tensor:
    """(4, 4) camera-to-world, OpenGL axes, with applied_transform undone."""
    if "transform_matrix" not in frame.entry:
        raise InputError(f'{frame.source}: frame {frame.name} has no "transform_matrix".')
    matrix = _as_4x4(frame.entry["transform_matrix"], f"transform_matrix of {frame.name}", frame.source)
    if "applied_transform" in frame.header:
        applied = _as_4x4(frame.header["applied_transform"], "applied_transform", frame.source)
        if not applied.isfinite().all() or abs(float(torch.linalg.det(applied))) < 1e-12:
            raise InputError(f"{frame.source}: applied_transform cannot be inverted; remove it or correct it.")
        matrix = torch.linalg.solve(applied, matrix)
    return matrix


def _as_4x4(rows: Any, what: str, source: Path) -> Tensor:
    short = isinstance(rows, list) and len(rows) == 3
    matrix = numbers(rows, (3, 4) if short else (4, 4), what, source)
    return torch.cat([matrix, torch.tensor([[0.0, 0, 0, 1]], dtype=torch.float64)]) if short else matrix


def _calibrated_size(frame: Frame) -> Tensor:
    """(2,) the w x h that the intrinsics are for; the image file's own size where the JSON doesn't say."""
    width, height = _value(frame, "w"), _value(frame, "h")
    size = image_size(frame.path) if width is None or height is None else (width, height)
    return torch.tensor(size, dtype=torch.float64)


def _intrinsics(frame: Frame, size: Tensor) -> Tensor:
    width, height = size.tolist()
    fx, fy = _value(frame, "fl_x"), _value(frame, "fl_y")
    angle_x, angle_y = _value(frame, "camera_angle_x"), _value(frame, "camera_angle_y")
    if fx is None and angle_x is not None:
        if not 0 < angle_x < math.pi:
            raise InputError(f"{frame.source}: camera_angle_x is {angle_x:g}; expected radians between 0 and pi.")
        fx = width / (2 * math.tan(angle_x / 2))
    if fy is None:
        fy = height / (2 * math.tan(angle_y / 2)) if angle_y is not None and _value(frame, "fl_x") is None else fx
    if fx is None or fy is None:
        raise InputError(
            f"{frame.source}: frame {frame.name} has neither fl_x nor camera_angle_x; add the focal length."
        )
    cx, cy = _value(frame, "cx"), _value(frame, "cy")
    return pinhole(fx, fy, width / 2 if cx is None else cx, height / 2 if cy is None else cy)


def _distortion(frame: Frame) -> Tensor:
    """(5,) k1, k2, p1, p2, k3."""
    model = frame.entry.get("camera_model", frame.header.get("camera_model", "OPENCV"))
    fisheye = frame.entry.get("is_fisheye", frame.header.get("is_fisheye", False))
    if fisheye or str(model).upper() not in MODELS or _value(frame, "k4"):
        what = "a fisheye lens" if fisheye else f'the camera model "{model}"' if not _value(frame, "k4") else "k4"
        raise InputError(
            f"{frame.source}: {frame.name} has {what}, which is not supported; "
            f"undistort the images first, or use one of {', '.join(sorted(MODELS))}."
        )
    return torch.tensor([_value(frame, k) or 0.0 for k in ("k1", "k2", "p1", "p2", "k3")], dtype=torch.float64)
