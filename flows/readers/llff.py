"""LLFF: poses_bounds.npy and image folders (images_8, images_4, ..., images).

Row i of poses_bounds.npy (N, 17) belongs to the i-th image in sorted order: a 3x5 matrix [R | t | height width focal],
camera-to-world with camera axes (down, right, backwards), then near and far depth. OpenCV: R = [col 1, col 0, -col 2].
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from flows.errors import InputError
from flows.readers import splits
from flows.readers.base import Capture
from flows.readers.parsing import cameras_for_files, images_in, pinhole

LOOKS_FOR = "poses_bounds.npy (LLFF)"
# The published protocol works at an eighth of the full size.
IMAGE_FOLDERS = ("images_8", "images_4", "images_2", "images")


def detect(path: Path) -> bool:
    return (path / "poses_bounds.npy").is_file()


def read(path: Path, image_folder: str | None, view_counts: tuple[int, ...]) -> Capture:
    """Principal point at the centre, no distortion; split by RegNeRF's rule."""
    source = path / "poses_bounds.npy"
    if not source.is_file():
        raise InputError(f"{path} has no poses_bounds.npy; it is not an LLFF scene.")
    try:
        rows = np.load(source, allow_pickle=False)
    except (ValueError, OSError, EOFError) as error:
        raise InputError(f"{source} cannot be read as a plain NumPy array ({error}).") from None
    if not isinstance(rows, np.ndarray) or rows.ndim != 2 or rows.shape[1] != 17 or rows.dtype.kind not in "fi":
        raise InputError(f"{source} has the shape {getattr(rows, 'shape', '?')}; expected N x 17 numbers.")
    folder = image_folder or next((f for f in IMAGE_FOLDERS if (path / f).is_dir()), "images")
    paths = images_in(path / folder, path)
    if len(paths) != len(rows):
        raise InputError(
            f"{source} has {len(rows)} rows, but {path / folder} has {len(paths)} images; they must match."
        )
    table = torch.as_tensor(rows, dtype=torch.float64)
    hwf = table[:, :15].reshape(-1, 3, 5)
    down, right, back, center = hwf[..., :4].unbind(-1)
    pose = torch.eye(4, dtype=torch.float64).repeat(len(rows), 1, 1)
    pose[:, :3] = torch.stack([right, down, -back, center], -1)
    height, width, focal = hwf[..., 4].unbind(-1)
    intrinsics = [pinhole(f, f, w / 2, h / 2) for h, w, f in hwf[..., 4].tolist()]
    names = [p.name for p in paths]
    notes = [f"Images are those of {folder}.", splits.EVERY_8TH]
    if (path / "sparse").is_dir():
        notes.append("A COLMAP model lies beside poses_bounds.npy and was not used; --reader colmap takes it instead.")
    return Capture(
        scene_id=path.resolve().name,
        dataset="llff",
        names=names,
        paths=paths,
        cameras=cameras_for_files(
            torch.stack(intrinsics), torch.stack([width, height], -1), pose, paths, names, source, notes
        ),
        depth_bounds=table[:, 15:].clone(),
        splits=splits.every_8th(len(rows), view_counts),
        notes=notes,
    )
