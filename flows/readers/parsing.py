"""What several readers need: checked JSON and numbers, camera conventions, intrinsics at the size of the image file."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from cat3d_core.cameras import Cameras, orthonormalize
from flows.errors import InputError
from flows.media.images import image_size, list_images

# Image and calibration may differ in aspect by rounding (3118 x 2078 -> 800 x 533), not by a crop or a turn.
ASPECT_TOLERANCE = 0.02
MIPNERF360_SCENES = frozenset(
    ["bicycle", "bonsai", "counter", "flowers", "garden", "kitchen", "room", "stump", "treehill"]
)
# Scene names that tell the family where the layout doesn't.
FAMILY_NAMES = {
    "mipnerf360": "mipnerf360",
    "360_v2": "mipnerf360",
    "re10k": "realestate10k",
    "realestate": "realestate10k",
    "co3d": "co3d",
    "dtu": "dtu",
    "llff": "llff",
    "nerf_synthetic": "nerf_synthetic",
}


def family_of(path: Path) -> str:
    """The data family by the scene folder's name ("capture" where it says nothing)."""
    name = path.resolve().name.lower()
    if name in MIPNERF360_SCENES:
        return "mipnerf360"
    return next((family for part, family in FAMILY_NAMES.items() if part in name), "capture")


def load_json(path: Path) -> Any:
    """The parsed file; InputError names the line of a syntax error."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except json.JSONDecodeError as error:
        raise InputError(
            f"{path} is not valid JSON: {error.msg} at line {error.lineno}, column {error.colno}; correct the file."
        ) from None
    except UnicodeDecodeError:
        raise InputError(f"{path} is not a text file in UTF-8; write it as JSON again.") from None
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}.") from None


def load_arrays(path: Path, keys: list[str]) -> dict[str, np.ndarray]:
    """Arrays of an .npz file, never unpickled. InputError for a missing key or a damaged file."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            lacking = [k for k in keys if k not in archive]
            if lacking:
                raise InputError(f'{path} has no array "{lacking[0]}"; it has: {", ".join(sorted(archive)[:10])}.')
            return {k: archive[k] for k in (keys or archive)}
    except InputError:
        raise
    except Exception as error:  # zipfile, struct, pickle refusal: numpy documents no common class
        raise InputError(f"{path} cannot be read as a NumPy archive of plain arrays ({error}).") from None


def numbers(values: Any, shape: tuple[int, ...], what: str, source: Path | str) -> Tensor:
    """A float64 tensor of this shape (finiteness is checked later, by view). InputError says what is malformed."""
    try:
        out = torch.as_tensor(np.array(values, dtype=np.float64))
    except (TypeError, ValueError):
        raise InputError(f"{source}: {what} is not made of numbers only.") from None
    if tuple(out.shape) != shape:
        raise InputError(f"{source}: {what} has the shape {tuple(out.shape)}; expected {shape}.")
    return out


def read_text_table(path: Path) -> list[list[float]]:
    """Rows of whitespace-separated numbers, empty lines skipped."""
    rows = []
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except UnicodeDecodeError:
        raise InputError(f"{path} is not a text file; give the camera file as published.") from None
    for i, line in enumerate(lines):
        try:
            row = [float(x) for x in line.split()]
        except ValueError:
            raise InputError(f"{path}, line {i + 1}: expected numbers, got {line.strip()[:60]!r}.") from None
        if row:
            rows.append(row)
    return rows


def pinhole(fx: float, fy: float, cx: float, cy: float) -> Tensor:
    """(3, 3) float64."""
    return torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64)


def from_opengl(world_from_camera: Tensor) -> Tensor:
    """(N, 4, 4) poses with OpenGL camera axes (x right, y up, z backwards) to OpenCV axes."""
    return world_from_camera * torch.tensor([1.0, -1, -1, 1], dtype=world_from_camera.dtype)


def from_camera_from_world(camera_from_world: Tensor) -> Tensor:
    """(N, 4, 4) rigid inverses."""
    pose = camera_from_world.clone()
    pose[:, :3, :3] = camera_from_world[:, :3, :3].transpose(1, 2)
    pose[:, :3, 3] = -(pose[:, :3, :3] @ camera_from_world[:, :3, 3:])[..., 0]
    return pose


def cameras_for_files(
    intrinsics: Tensor, calibrated_size: Tensor, world_from_camera: Tensor, paths: list[Path], names: list[str],
    source: Path | str, notes: list[str],
) -> Cameras:  # fmt: skip
    """Cameras at the size of the image files.

    intrinsics (N, 3, 3) for images of calibrated_size (N, 2) [width, height]; poses (N, 4, 4), OpenCV axes. Where a
    file has another size its K is scaled, and a note says so. Poses are made exactly rigid after they passed as rigid
    (to 1e-3). Raises InputError naming the view: another aspect ratio, and what `Cameras.validate` finds.
    """
    size = torch.tensor([image_size(p) for p in paths], dtype=torch.int64).reshape(-1, 2)
    for name, (w, h), (w0, h0) in zip(names, size.tolist(), calibrated_size.tolist(), strict=True):
        if not (w0 > 0 and h0 > 0):
            raise InputError(
                f"{source}: view {name} has an image size of {w0:g} x {h0:g} pixels; both must be positive."
            )
        if abs((w / h) / (w0 / h0) - 1) > ASPECT_TOLERANCE:
            raise InputError(
                f"{source}: view {name} is calibrated for {w0:g} x {h0:g} pixels, but its image, upright, is "
                f"{w} x {h}; another aspect ratio (a crop, or a turn by EXIF orientation) cannot be made up for."
            )
    factors = size.double() / calibrated_size.double()
    if (factors - 1).abs().max() > 1e-9:
        first, to = calibrated_size[0].tolist(), size[0].tolist()
        notes.append(
            f"Intrinsics were scaled from {first[0]:g} x {first[1]:g} to the image files' {to[0]} x {to[1]} pixels."
        )
    intrinsics = intrinsics.clone()
    intrinsics[:, :2] *= factors[:, :, None]
    cameras = Cameras(intrinsics, world_from_camera, size)
    try:
        cameras.validate(names)
    except ValueError as error:
        raise InputError(f"{source}: {error}") from None
    return Cameras(intrinsics, orthonormalize(world_from_camera), size)


def images_in(folder: Path, scene: Path) -> list[Path]:
    """Sorted image files of a folder. InputError when it is missing, leaves the scene's folder, or holds none."""
    if not folder.is_dir():
        raise InputError(f"{scene} has no folder {folder.name} with images.")
    paths = list_images(folder)
    if not paths:
        raise InputError(f"{folder} holds no images; put the photos there.")
    root = scene.resolve()
    for path in paths:
        if not path.resolve().is_relative_to(root):
            raise InputError(f"{path} is a symbolic link out of {scene}; copy the file into the folder.")
    return paths


def unlisted_note(count: int, what: str, examples: list[str]) -> str:
    """A note about things left out."""
    return f"{count} {what} left out: {', '.join(examples[:3])}{' …' if len(examples) > 3 else ''}."
