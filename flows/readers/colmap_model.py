"""COLMAP's models as files: cameras, images and points, binary or text, also written by hand.

Own readers, since names may be in any encoding and hand-made lists leave lines out, which a strict reader takes for
something else without a word. Formats: https://colmap.github.io/format.html.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from cat3d_core.quaternions import unit_rotations
from flows.errors import InputError

#: Camera models in the order of their numbers in binary files, with the length of their parameters.
MODELS = (
    ("SIMPLE_PINHOLE", 3),
    ("PINHOLE", 4),
    ("SIMPLE_RADIAL", 4),
    ("RADIAL", 5),
    ("OPENCV", 8),
    ("OPENCV_FISHEYE", 8),
    ("FULL_OPENCV", 12),
    ("FOV", 5),
    ("SIMPLE_RADIAL_FISHEYE", 4),
    ("RADIAL_FISHEYE", 5),
    ("THIN_PRISM_FISHEYE", 12),
    ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
    ("SIMPLE_DIVISION", 4),
    ("DIVISION", 5),
    ("SIMPLE_FISHEYE", 3),
    ("FISHEYE", 4),
    ("EUCM", 6),
    ("EQUIRECTANGULAR", 2),
)
LENGTHS = dict(MODELS)
PARTS = ("cameras", "images", "points3D")


@dataclass(frozen=True)
class ModelCamera:
    """One camera of a model: COLMAP's model name, size in pixels, parameters in COLMAP's order."""

    model: str
    width: int
    height: int
    params: tuple[float, ...]


@dataclass(frozen=True)
class ModelImage:
    """One registered image: its name as written, its camera, camera_from_world (4, 4) float64 with OpenCV axes."""

    name: str
    camera_id: int
    camera_from_world: Tensor


@dataclass(frozen=True)
class Model:
    """A reconstruction. points (P, 3) float64 in the world frame; notes on what the files lack."""

    folder: Path
    cameras: dict[int, ModelCamera]
    images: list[ModelImage]
    points: np.ndarray
    notes: list[str]


def has_model(folder: Path) -> bool:
    """Whether the cameras of a model lie in the folder."""
    return any((folder / f"cameras.{kind}").is_file() for kind in ("bin", "txt"))


def load_model(folder: Path) -> Model:
    """The model in `folder`, the binary files where both kinds are there.

    Raises InputError for a missing, cut or malformed file, an unknown camera model, and an image without its camera.
    """
    kind = "bin" if (folder / "cameras.bin").is_file() else "txt"
    notes = []
    if kind == "bin" and (folder / "images.txt").is_file():
        notes.append(f"{folder.name} has the model as binary and as text files; the binary ones were read.")
    files = {part: folder / f"{part}.{kind}" for part in PARTS}
    for part in ("cameras", "images"):
        if not files[part].is_file():
            raise InputError(f"The COLMAP model {folder} has no {files[part].name}; copy the whole model.")
    cameras = (_binary_cameras if kind == "bin" else _text_cameras)(files["cameras"])
    images = (_binary_images if kind == "bin" else _text_images)(files["images"])
    points = np.zeros((0, 3))
    if files["points3D"].is_file():
        points = (_binary_points if kind == "bin" else _text_points)(files["points3D"])
    else:
        notes.append(f"The model has no {files['points3D'].name}: there are no sparse points.")
    for image in images:
        if image.camera_id not in cameras:
            raise InputError(
                f"{files['images']}: image {image.name} has camera {image.camera_id}, which {files['cameras'].name} "
                "does not list; copy the whole model."
            )
    return Model(folder, cameras, images, points, notes)


def _pose(quaternion: np.ndarray, translation: np.ndarray, name: str, file: Path) -> Tensor:
    """camera_from_world (4, 4) of a quaternion (w, x, y, z), of any length but zero, and a translation."""
    length = float(np.linalg.norm(quaternion))
    if not length > 1e-9:
        raise InputError(f"{file}: image {name} has a rotation quaternion of length {length:g}; correct it.")
    out = torch.eye(4, dtype=torch.float64)
    out[:3, :3] = unit_rotations(torch.from_numpy(quaternion / length))
    out[:3, 3] = torch.as_tensor(translation)
    return out


class _Bytes:
    """A binary file read front to back; past its end it is cut short."""

    def __init__(self, file: Path, smallest_record: int) -> None:
        self.file, self.data, self.at = file, file.read_bytes(), 0
        (self.count,) = self.take("<Q")
        content = len(self.data) - 8
        if self.count * smallest_record > content:
            raise InputError(
                f"{file} is cut short: it announces {self.count} entries in {content} bytes; copy it anew."
            )

    def take(self, form: str) -> tuple:
        size = struct.calcsize(form)
        self.skip(size)
        return struct.unpack_from(form, self.data, self.at - size)

    def skip(self, size: int) -> None:
        self.at += size
        if self.at > len(self.data):
            raise InputError(f"{self.file} is cut short after {len(self.data)} bytes; copy it again.")

    def name(self) -> str:
        end = self.data.find(b"\0", self.at)
        if end < 0:
            self.skip(len(self.data) + 1)
        raw, self.at = self.data[self.at : end], end + 1
        return _decoded(raw)


def _decoded(raw: bytes) -> str:
    """Text of a name: UTF-8, else Latin-1 as older Windows programs write it."""
    try:
        return raw.decode("utf-8")
    except UnicodeDecodeError:
        return raw.decode("latin-1")


def _binary_cameras(file: Path) -> dict[int, ModelCamera]:
    data, out = _Bytes(file, 24 + 16), {}
    for _ in range(data.count):
        number, model, width, height = data.take("<iiQQ")
        if not 0 <= model < len(MODELS):
            raise InputError(f"{file} cannot be read: camera {number} has the unknown model number {model}.")
        name, length = MODELS[model]
        out[number] = ModelCamera(name, width, height, data.take(f"<{length}d"))
    return out


def _binary_images(file: Path) -> list[ModelImage]:
    data, out = _Bytes(file, 4 + 56 + 4 + 1 + 8), []
    for _ in range(data.count):
        values = data.take("<i7di")
        name = data.name()
        (observed,) = data.take("<Q")
        data.skip(24 * observed)
        out.append(ModelImage(name, values[8], _pose(np.array(values[1:5]), np.array(values[5:8]), name, file)))
    return out


def _binary_points(file: Path) -> np.ndarray:
    data = _Bytes(file, 8 + 24 + 3 + 8 + 8)
    out = np.zeros((data.count, 3))
    for i in range(data.count):
        values = data.take("<Q3d3BdQ")
        data.skip(8 * values[-1])
        out[i] = values[1:4]
    return out


def _lines(file: Path) -> Iterator[tuple[int, str]]:
    """Numbered lines without comments; a byte order mark and either line end are taken off, empty lines stay."""
    text = _decoded(file.read_bytes()).removeprefix("\ufeff").removeprefix("ï»¿")
    for number, line in enumerate(text.split("\n"), start=1):
        line = line.rstrip("\r")
        if not line.lstrip().startswith("#"):
            yield number, line


def _text_cameras(file: Path) -> dict[int, ModelCamera]:
    out = {}
    for number, line in _lines(file):
        parts = line.split()
        if not parts:
            continue
        try:
            key, model, width, height = int(parts[0]), parts[1].upper(), int(float(parts[2])), int(float(parts[3]))
            params = tuple(float(p) for p in parts[4:])
        except (ValueError, IndexError):
            raise InputError(
                f"{file} cannot be read (line {number}: expected CAMERA_ID MODEL WIDTH HEIGHT PARAMS, got "
                f"{line[:60]!r})."
            ) from None
        if model not in LENGTHS or len(params) != LENGTHS[model]:
            wanted = f"{LENGTHS[model]} parameters, it has {len(params)}" if model in LENGTHS else "a model of COLMAP"
            raise InputError(f"{file} cannot be read (line {number}: {model} is not {wanted}).")
        out[key] = ModelCamera(model, width, height, params)
    return out


def _text_images(file: Path) -> list[ModelImage]:
    """Images of a text model: a line each, with a line of observations behind it or, made by hand, without."""
    out: list[ModelImage] = []
    observations_next = False
    for number, line in _lines(file):
        if observations_next and _is_observations(line):
            observations_next = False
            continue
        if not line.strip():
            continue
        parts = line.split(None, 9)
        try:
            values = np.array([float(p) for p in parts[1:8]])
            camera, name = int(parts[8]), parts[9].strip()
            int(parts[0])
        except (ValueError, IndexError):
            raise InputError(
                f"{file} cannot be read (line {number}: expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, got "
                f"{line[:60]!r})."
            ) from None
        out.append(ModelImage(name, camera, _pose(values[:4], values[4:], name, file)))
        observations_next = True
    return out


def _is_observations(line: str) -> bool:
    """Whether a line is empty or made of X Y POINT3D_ID triples."""
    parts = line.split()
    if len(parts) % 3:
        return False
    try:
        [float(p) for p in parts]
        [int(p) for p in parts[2::3]]
    except ValueError:
        return False
    return True


def _text_points(file: Path) -> np.ndarray:
    rows = []
    for number, line in _lines(file):
        parts = line.split(None, 4)
        if not parts:
            continue
        try:
            rows.append([float(p) for p in parts[1:4]])
            if len(rows[-1]) != 3:
                raise ValueError
        except ValueError:
            raise InputError(
                f"{file} cannot be read (line {number}: expected POINT3D_ID X Y Z ..., got {line[:60]!r})."
            ) from None
    return np.array(rows).reshape(-1, 3)
