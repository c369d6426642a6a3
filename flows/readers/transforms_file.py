"""One transforms.json: its frames, and what their entries say about camera and lens.

Two dialects: nerfstudio's and instant-ngp's (also used for NeRF's synthetic scenes). A key may stand in the header for
all frames or in a frame for itself.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from flows.errors import InputError
from flows.media.files import image_size
from flows.readers.lenses import Lens, coefficients
from flows.readers.matching import Finder, split_name
from flows.readers.parsing import load_json, numbers, pinhole

# camera_model -> whether it is a fisheye. nerfstudio writes COLMAP's names and some of its own.
MODELS = {
    "OPENCV": False,
    "PINHOLE": False,
    "SIMPLE_PINHOLE": False,
    "SIMPLE_RADIAL": False,
    "RADIAL": False,
    "PERSPECTIVE": False,
    "FULL_OPENCV": False,
    "OPENCV_FISHEYE": True,
    "FISHEYE": True,
    "SIMPLE_RADIAL_FISHEYE": True,
    "RADIAL_FISHEYE": True,
}
LENS_KEYS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
# instant-ngp's own lenses, which are no pinhole images and no OpenCV distortion.
OTHER_LENSES = ("ftheta_p0", "latlong", "equirectangular")
HEADER_KEYS = frozenset(
    ["frames", "w", "h", "fl_x", "fl_y", "cx", "cy", "camera_angle_x", "camera_angle_y", "x_fov", "y_fov"]
    + ["camera_model", "is_fisheye", "applied_transform", "applied_scale", *LENS_KEYS]
    + ["train_filenames", "val_filenames", "test_filenames"]
)
FRAME_KEYS = HEADER_KEYS - {"frames"} | {"file_path", "transform_matrix", "mask_path"}


@dataclass
class Frame:
    """One frame of a transforms.json whose image exists. `json_id` is its place in the file's list."""

    json_id: int
    name: str
    path: Path
    entry: dict[str, Any]
    header: dict[str, Any]
    source: Path

    def value(self, key: str) -> float | None:
        """A number of the frame, else of the file's header."""
        value = self.entry.get(key, self.header.get(key))
        if value is None:
            return None
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise InputError(f'{self.source}: "{key}" of {self.name} is {value!r}; expected a number.')
        return float(value)


@dataclass
class Listing:
    """The frames of one file, sorted by name; names of frames without an image; notes."""

    frames: list[Frame]
    missing: list[str]
    finder: Finder
    image_folder: str | None
    header: dict[str, Any]
    notes: list[str]

    def views(self, names: Iterable[str]) -> tuple[list[int], list[str]]:
        """Indices of the frames that these names of images mean, ascending, and the names that are no frame's."""
        of_path = {frame.path: view for view, frame in enumerate(self.frames)}
        of_name = {frame.name: view for view, frame in enumerate(self.frames)}
        found, unknown = set(), []
        for name in names:
            view = of_name.get("/".join(split_name(name)))
            if view is None:
                path = self.finder.find_all([name], self.image_folder)[0]
                view = None if path is None else of_path.get(path)
            if view is None:
                unknown.append(name)
            else:
                found.add(view)
        return sorted(found), unknown


def load_frames(root: Path, file_name: str, image_folder: str | None = None) -> Listing:
    """The frames of a file whose image exists. InputError for a malformed file, or one without any image."""
    source = root / file_name
    header = load_json(source)
    entries = header.get("frames") if isinstance(header, dict) else None
    if not isinstance(entries, list) or not entries:
        raise InputError(f'{source} has no list "frames"; it is not a transforms.json, or has no views.')
    for i, entry in enumerate(entries):
        if not isinstance(entry, dict) or not isinstance(entry.get("file_path"), str):
            raise InputError(f'{source}: frame {i} has no "file_path".')
    finder = Finder(root, source)
    frames, missing = [], []
    paths = finder.find_all([entry["file_path"] for entry in entries], image_folder)
    for i, (entry, path) in enumerate(zip(entries, paths, strict=True)):
        name = "/".join(split_name(entry["file_path"]))
        if path is None:
            missing.append(name)
            continue
        if image_folder or name not in (known := str(path.relative_to(root)), str(Path(known).with_suffix(""))):
            name = str(path.relative_to(root))
        frames.append(Frame(i, name, path, entry, header, source))
    if not frames:
        where = f" in {root / image_folder}" if image_folder else ""
        raise InputError(
            f"{source} lists {len(entries)} frames, but none of their images exists{where} (first: {missing[0]})."
        )
    frames.sort(key=lambda f: f.name)
    return Listing(frames, missing, finder, image_folder, header, [*finder.notes(), *_ignored(header, entries)])


def pose(frame: Frame) -> Tensor:
    """(4, 4) camera-to-world, OpenGL axes, with applied_scale and applied_transform undone."""
    if "transform_matrix" not in frame.entry:
        raise InputError(f'{frame.source}: frame {frame.name} has no "transform_matrix".')
    matrix = _as_4x4(frame.entry["transform_matrix"], f"transform_matrix of {frame.name}", frame.source)
    scale = frame.header.get("applied_scale")
    if scale is not None:
        if isinstance(scale, bool) or not isinstance(scale, (int, float)) or not scale > 0:
            raise InputError(f"{frame.source}: applied_scale is {scale!r}; expected a positive number.")
        matrix = matrix.clone()
        matrix[:3, 3] /= scale
    if "applied_transform" in frame.header:
        applied = _as_4x4(frame.header["applied_transform"], "applied_transform", frame.source)
        if not applied.isfinite().all() or abs(float(torch.linalg.det(applied))) < 1e-12:
            raise InputError(f"{frame.source}: applied_transform cannot be inverted; remove it or correct it.")
        matrix = torch.linalg.solve(applied, matrix)
    return matrix


def calibrated_size(frame: Frame) -> tuple[float, float] | None:
    """The (w, h) that the intrinsics are for, None where the file doesn't say."""
    width, height = frame.value("w"), frame.value("h")
    return None if width is None or height is None else (width, height)


def stored_size(frame: Frame, listing: Listing) -> tuple[int, int]:
    """(width, height) of the image that the file names: not of a smaller one that was chosen in its place."""
    named = listing.finder.find_all([frame.entry["file_path"]])[0] if listing.image_folder else None
    return image_size(named or frame.path, upright=False)


def lens(frame: Frame, size: tuple[float, float]) -> Lens:
    """K for images of `size`, and the distortion. Focal lengths as instant-ngp reads them: x_fov (degrees), fl_x,
    camera_angle_x (radians), the first that is there; one axis stands for both."""
    width, height = size
    fx, fy = _focal(frame, "x", width), _focal(frame, "y", height)
    fx, fy = fx if fx is not None else fy, fy if fy is not None else fx
    if fx is None or fy is None:
        raise InputError(
            f"{frame.source}: frame {frame.name} has neither fl_x nor camera_angle_x; add the focal length."
        )
    cx, cy = frame.value("cx"), frame.value("cy")
    model = frame.entry.get("camera_model", frame.header.get("camera_model", "OPENCV"))
    known = MODELS.get(str(model).upper())
    other = next((k for k in OTHER_LENSES if frame.entry.get(k, frame.header.get(k))), None)
    if known is None or other is not None:
        raise InputError(
            f'{frame.source}: {frame.name} has the camera model "{other or model}", which is not supported; '
            f"undistort the images first, or use one of {', '.join(sorted(MODELS))}."
        )
    fisheye = known or bool(frame.entry.get("is_fisheye", frame.header.get("is_fisheye", False)))
    values = {key: frame.value(key) or 0.0 for key in LENS_KEYS}
    if fisheye:
        values |= {"p1": 0.0, "p2": 0.0}  # nerfstudio writes what it read, and neither program uses them
    center = (width / 2 if cx is None else cx, height / 2 if cy is None else cy)
    return Lens(pinhole(fx, fy, *center), coefficients(values, fisheye, frame.source, str(model)), fisheye)


def _focal(frame: Frame, axis: str, side: float) -> float | None:
    fov, focal = frame.value(f"{axis}_fov"), frame.value(f"fl_{axis}")
    angle = math.radians(fov) if fov is not None else frame.value(f"camera_angle_{axis}")
    if fov is None and focal is not None:
        return focal
    if angle is None:
        return None
    if not 0 < angle < math.pi:
        what = f"{axis}_fov is {fov:g}; expected degrees between 0 and 180" if fov is not None else (
            f"camera_angle_{axis} is {angle:g}; expected radians between 0 and pi"
        )  # fmt: skip
        raise InputError(f"{frame.source}: {what}.")
    return side / (2 * math.tan(angle / 2))


def _as_4x4(rows: Any, what: str, source: Path) -> Tensor:
    short = isinstance(rows, list) and len(rows) == 3
    matrix = numbers(rows, (3, 4) if short else (4, 4), what, source)
    return torch.cat([matrix, torch.tensor([[0.0, 0, 0, 1]], dtype=torch.float64)]) if short else matrix


def _ignored(header: dict[str, Any], entries: list[dict[str, Any]]) -> list[str]:
    """One note that names the keys of the file which are not used."""
    unused = sorted(header.keys() - HEADER_KEYS) + sorted({k for e in entries for k in e} - FRAME_KEYS)
    return [f"Of the file's keys these are not used: {', '.join(dict.fromkeys(unused))}."] if unused else []
