"""LLFF: poses_bounds.npy and image folders (images_8, images_4, ..., images).

Row i of poses_bounds.npy (N, 17) belongs to the i-th image that was reconstructed, in sorted order: a 3x5 matrix
[R | t | height width focal], camera-to-world with camera axes (down, right, backwards), then near and far depth.
OpenCV: R = [col 1, col 0, -col 2]. The file says no names: where images and rows differ in number, they come from the
COLMAP model that the poses were made from, from the full-size images, or from numbers in the names.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from flows.errors import InputError
from flows.media.files import list_images
from flows.readers import splits
from flows.readers.base import Capture
from flows.readers.colmap_model import has_model, load_model
from flows.readers.matching import rows_by_number, split_name
from flows.readers.parsing import cameras_for_files, images_in, pinhole, unlisted_note

LOOKS_FOR = "poses_bounds.npy (LLFF)"
# The published protocol works at an eighth of the full size.
IMAGE_FOLDERS = ("images_8", "images_4", "images_2", "images")


def detect(path: Path) -> bool:
    return (path / "poses_bounds.npy").is_file()


def read(path: Path, image_folder: str | None, view_counts: tuple[int, ...]) -> Capture:
    """Principal point at the centre, no distortion; split by RegNeRF's rule."""
    table = _table(path / "poses_bounds.npy")
    folder = image_folder or next((f for f in IMAGE_FOLDERS if (path / f).is_dir()), "images")
    notes = [f"Images are those of {folder}."]
    images = images_in(path / folder, path)
    row_of = _rows(images, len(table), path, notes)
    paths, table = list(row_of), table[list(row_of.values())]
    names = [p.name for p in paths]
    hwf = table[:, :15].reshape(-1, 3, 5)
    down, right, back, center = hwf[..., :4].unbind(-1)
    pose = torch.eye(4, dtype=torch.float64).repeat(len(paths), 1, 1)
    pose[:, :3] = torch.stack([right, down, -back, center], -1)
    height, width, _ = hwf[..., 4].unbind(-1)
    intrinsics = torch.stack([pinhole(f, f, w / 2, h / 2) for h, w, f in hwf[..., 4].tolist()])
    size = torch.stack([width, height], -1)
    placed = cameras_for_files(intrinsics, size, pose, paths, names, path / "poses_bounds.npy", notes)
    return Capture(
        scene_id=path.resolve().name,
        dataset="llff",
        names=names,
        paths=paths,
        cameras=placed.cameras,
        upright=placed.upright,
        depth_bounds=table[:, 15:].clone(),
        splits=splits.every_8th(len(paths), view_counts),
        notes=[*notes, splits.EVERY_8TH],
    )


def _table(source: Path) -> torch.Tensor:
    """(N, 17) float64."""
    if not source.is_file():
        raise InputError(f"{source.parent} has no poses_bounds.npy; it is not an LLFF scene.")
    try:
        rows = np.load(source, allow_pickle=False)
    except Exception as error:  # from the tokenizer to the allocator: numpy documents no common class
        raise InputError(f"{source} cannot be read as a plain NumPy array ({error}).") from None
    if not isinstance(rows, np.ndarray) or rows.ndim != 2 or rows.shape[1] != 17 or rows.dtype.kind not in "fi":
        raise InputError(f"{source} has the shape {getattr(rows, 'shape', '?')}; expected N x 17 numbers.")
    return torch.as_tensor(rows, dtype=torch.float64)


def _rows(images: list[Path], count: int, scene: Path, notes: list[str]) -> dict[Path, int]:
    """Which row each image has; images without one are left out and named."""
    found: dict[Path, int] = {}
    for names, whence in _row_names(scene, count):
        row_by_stem = {Path(name).stem: i for i, name in enumerate(names)}
        found = {p: row_by_stem[p.stem] for p in images if p.stem in row_by_stem}
        if len(found) == len(images) == count:
            return found
        if found:
            notes.append(f"poses_bounds.npy has {count} rows for {len(images)} images: {whence} tells which is whose.")
            break
    else:
        if len(images) == count:
            return {path: i for i, path in enumerate(images)}
        by_number = rows_by_number([p.stem for p in images], range(count))
        if by_number is None or len(images) > count:
            raise InputError(
                f"{scene / 'poses_bounds.npy'} has {count} rows, but {images[0].parent} has {len(images)} images, and "
                "nothing tells which row is whose; remove the images without a pose, or put the COLMAP model "
                "(sparse/0) beside it."
            )
        found = {path: row for path, row in zip(images, by_number, strict=True) if row is not None}
        notes.append(
            f"poses_bounds.npy has {count} rows for {len(images)} images: numbers in the names tell which is whose."
        )
    without = [p.name for p in images if p not in found]
    if without:
        notes.append(unlisted_note(len(without), "images without a row in poses_bounds.npy were", without))
    if count > len(found):
        idle = [str(i) for i in range(count) if i not in found.values()]
        notes.append(unlisted_note(len(idle), "rows of poses_bounds.npy without an image were", idle))
    return found


def _row_names(scene: Path, count: int) -> list[tuple[list[str], str]]:
    """Lists of as many names as there are rows, in the order of the rows, and where each is from."""
    out = []
    for folder in (scene / "sparse" / "0", scene / "sparse"):
        if has_model(folder):
            names = sorted(split_name(image.name)[-1] for image in load_model(folder).images)
            out.append((names, f"the COLMAP model {folder.name}"))
    for folder in (scene / name for name in reversed(IMAGE_FOLDERS)):
        if folder.is_dir():
            out.append(([p.name for p in list_images(folder)], f"the folder {folder.name}"))
    return [(names, whence) for names, whence in out if len(names) == count]
