"""What several readers need: checked JSON and numbers, camera conventions, intrinsics at the size of the image file."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from cat3d_core.cameras import Cameras, orthonormalize
from flows.errors import InputError
from flows.media.files import image_size, list_images, orientation
from flows.media.packed import check_zip
from flows.readers.matching import check_link

# Image and calibration may differ in aspect by rounding (3118 x 2078 -> 800 x 533), not by a crop or a turn.
ASPECT_TOLERANCE = 0.02
# Where in the image, in units of its size, a principal point may lie before another image size is looked for.
CENTRAL = (0.25, 0.75)
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
        return json.loads(path.read_text(encoding="utf-8-sig"))
    except json.JSONDecodeError as error:
        raise InputError(
            f"{path} is not valid JSON: {error.msg} at line {error.lineno}, column {error.colno}; correct the file."
        ) from None
    except UnicodeDecodeError:
        raise InputError(f"{path} is not a text file in UTF-8; write it as JSON again.") from None
    except RecursionError:
        raise InputError(f"{path} is nested deeper than any description of a scene; correct the file.") from None
    except ValueError as error:  # such as a number of more than 4,300 digits
        raise InputError(f"{path} is not valid JSON: {error}; correct the file.") from None
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}.") from None


def load_arrays(path: Path, keys: list[str]) -> dict[str, np.ndarray]:
    """Arrays of an .npz file (all of them for no `keys`), never unpickled. InputError for a missing key or damage."""
    try:
        check_zip(path)
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
        lines = path.read_text(encoding="utf-8-sig").splitlines()
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


class Placed(NamedTuple):
    """Cameras (N) at the size of their image files, and whether those are to be turned upright by EXIF first."""

    cameras: Cameras
    upright: bool


def cameras_for_files(
    intrinsics: Tensor, calibrated_size: Tensor, world_from_camera: Tensor, paths: list[Path], names: list[str],
    source: Path | str, notes: list[str],
) -> Placed:  # fmt: skip
    """Cameras at the size of the image files.

    intrinsics (N, 3, 3) for images of calibrated_size (N, 2) [width, height]; poses (N, 4, 4), OpenCV axes. Given
    cameras belong to the pixels as they are stored: the programs that write them ignore EXIF orientation. Only where
    the calibrated size fits none but the upright image is it turned. Where a file has another size its K is scaled;
    notes say so. Poses are made exactly rigid after they passed as rigid (to 1e-3). Raises InputError naming the view:
    another aspect ratio, and what `Cameras.validate` finds.
    """
    for name, (w0, h0) in zip(names, calibrated_size.tolist(), strict=True):
        if not (0 < w0 < math.inf and 0 < h0 < math.inf):
            raise InputError(
                f"{source}: view {name} has an image size of {w0:g} x {h0:g} pixels; both must be positive."
            )
    upright = _turned(calibrated_size, paths, names, source, notes)
    size = files_size(paths, upright)
    for name, (w, h), (w0, h0) in zip(names, size.tolist(), calibrated_size.tolist(), strict=True):
        if not _same_aspect(w, h, w0, h0):
            raise InputError(
                f"{source}: view {name} is calibrated for {w0:g} x {h0:g} pixels, but its image is {w} x {h}; "
                "another aspect ratio (a crop, or a turn) cannot be made up for."
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
    return Placed(Cameras(intrinsics, orthonormalize(world_from_camera), size), upright)


def files_size(paths: Sequence[Path], upright: bool = False) -> Tensor:
    """(N, 2) int64 [width, height] of image files, as stored unless `upright`."""
    return torch.tensor([image_size(p, upright=upright) for p in paths], dtype=torch.int64).reshape(-1, 2)


def _turned(calibrated: Tensor, paths: list[Path], names: list[str], source: Path | str, notes: list[str]) -> bool:
    """Whether the cameras belong to the upright images, which only photos turned by 90 degrees can tell."""
    turns = [orientation(p) for p in paths]
    tagged = [i for i, turn in enumerate(turns) if turn > 1]
    if not tagged:
        return True  # there is nothing to turn
    stored: list[int] = []
    upright: list[int] = []
    for i in (i for i in tagged if turns[i] >= 5):
        width, height = image_size(paths[i], upright=False)
        fits, fits_turned = (
            _same_aspect(*size, *calibrated[i].tolist()) for size in ((width, height), (height, width))
        )
        if fits != fits_turned:
            (stored if fits else upright).append(i)
    if stored and upright:
        raise InputError(
            f"{source}: the camera of {names[stored[0]]} is for the image as stored, that of {names[upright[0]]} for "
            "the image turned by its EXIF orientation; turn all images upright and calibrate them again."
        )
    whose = f"{len(tagged)} of {len(paths)} images have an EXIF orientation"
    if upright:
        notes.append(f"{whose}; they were turned upright, as only then their sizes are those of the cameras.")
    else:
        notes.append(f"{whose}, which was ignored: given cameras belong to the pixels as they are stored.")
    return bool(upright)


def _same_aspect(w: float, h: float, w0: float, h0: float) -> bool:
    return abs(w * h0 - h * w0) <= ASPECT_TOLERANCE * h * w0


def implied_size(
    intrinsics: Tensor, size: Tensor, others: Sequence[tuple[float, float]], source: Path | str, notes: list[str]
) -> Tensor:
    """(N, 2) the image size that intrinsics without one are for, by where their principal point lies.

    intrinsics (N, 3, 3); size (N, 2) of the image files; others: sizes that are likely (of other image folders). The
    files' own size where the principal point is well inside them. Elsewhere the one of `others` that puts it near the
    middle, else twice the principal point where both axes agree on the factor. Raises InputError where nothing fits.
    """
    center = intrinsics[:, :2, 2] / size.double()
    if not center.isfinite().all() or ((center > CENTRAL[0]) & (center < CENTRAL[1])).all():
        return size.double()
    middle = intrinsics[:, :2, 2].median(0).values
    for width, height in others:
        x, y = (middle / torch.tensor([width, height], dtype=torch.float64)).tolist()
        if 0.4 < x < 0.6 and 0.4 < y < 0.6 and _same_aspect(width, height, *size[0].tolist()):
            notes.append(
                f"The principal point lies in the middle of {width:g} x {height:g} pixels, not of the image files: the "
                "intrinsics were taken to be for that size."
            )
            return torch.tensor([[width, height]], dtype=torch.float64).expand(len(size), 2).clone()
    factors = 2 * center
    x, y = factors.median(0).values.tolist()
    if not (x > 0 and y > 0 and abs(x / y - 1) < 0.1):
        raise InputError(
            f"{source}: the principal point ({middle[0]:g}, {middle[1]:g}) lies far from the middle of the images "
            f"({size[0, 0]} x {size[0, 1]} pixels), and the file gives no image size; add the width and height of the "
            "images that were calibrated (w and h)."
        )
    factor = (x * y) ** 0.5
    whole = round(factor) if factor >= 1 else 1 / round(1 / factor)
    # A centre that was set is exact in both axes; one that was estimated is off by some percent, and sizes are halved.
    factor = whole if abs(x / y - 1) > 0.005 and abs(factor / whole - 1) < 0.05 else factor
    notes.append(
        f"The principal point ({middle[0]:g}, {middle[1]:g}) is the middle of images {factor:.3g} times as large as "
        f"the files ({size[0, 0]} x {size[0, 1]} pixels): the intrinsics were scaled down by that."
    )
    return size.double() * factor


def images_in(folder: Path, scene: Path) -> list[Path]:
    """Sorted image files of a folder. InputError when it is missing, leaves the scene's folder, or holds none."""
    if not folder.is_dir():
        raise InputError(f"{scene} has no folder {folder.name} with images.")
    check_link(folder, scene)
    paths = list_images(folder)
    if not paths:
        raise InputError(f"{folder} holds no images; put the photos there.")
    for path in paths:
        check_link(path, scene)
    return paths


def unlisted_note(count: int, what: str, examples: list[str]) -> str:
    """A note about things left out, which names the first twelve."""
    return f"{count} {what} left out: {', '.join(examples[:12])}{' …' if len(examples) > 12 else ''}."
