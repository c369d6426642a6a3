"""DTU as preprocessed by IDR and NeuS: image/, mask/, cameras_sphere.npz (or cameras.npz).

world_mat_i = K [R | t], world to pixels of the original 1600 x 1200 image, OpenCV axes, millimetres. scale_mat_i maps
the unit sphere to the object's sphere in the world. NeuS's BlendedMVS scenes have the same layout at their own size.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from flows.errors import InputError
from flows.media.files import image_size, list_images
from flows.readers import splits
from flows.readers.base import Capture
from flows.readers.matching import numbers_in, rows_by_number
from flows.readers.parsing import (
    cameras_for_files,
    files_size,
    from_camera_from_world,
    images_in,
    implied_size,
    load_arrays,
    numbers,
    unlisted_note,
)

LOOKS_FOR = "cameras_sphere.npz or cameras.npz beside image/ (DTU, IDR/NeuS)"
CAMERA_FILES = ("cameras_sphere.npz", "cameras.npz", "cameras_large.npz")
DTU_SIZE = (1600, 1200)
DTU_VIEWS = 49


def detect(path: Path) -> bool:
    return _camera_file(path) is not None


def read(path: Path, image_folder: str | None, view_counts: tuple[int, ...]) -> Capture:
    """Camera world_mat_i belongs to the image with the number i in its name; where there are as many cameras as images
    and the numbers don't fit, to the i-th in sorted order. Near and far are those of the object's sphere, when it is in
    front."""
    source = _camera_file(path)
    if source is None:
        raise InputError(f"{path} has none of {', '.join(CAMERA_FILES)}; it is not a DTU scene.")
    folder = image_folder or next((f for f in ("image", "images", "rgb") if (path / f).is_dir()), "image")
    found = images_in(path / folder, path)
    arrays = load_arrays(source, [])
    notes: list[str] = []
    row_of = _rows(found, arrays, source, notes)
    paths, rows = list(row_of), list(row_of.values())
    names = [p.name for p in paths]
    matrices = torch.stack([numbers(arrays[f"world_mat_{i}"], (4, 4), f"world_mat_{i}", source)[:3] for i in rows])
    for name, matrix in zip(names, matrices, strict=True):
        if not matrix.isfinite().all() or abs(float(torch.linalg.det(matrix[:, :3]))) < 1e-12:
            raise InputError(
                f"{source}: the projection matrix of view {name} is NaN or singular; correct or remove it."
            )
    intrinsics, poses = decompose_projection(matrices)
    center = (intrinsics[:, :2, 2].mean(0) / torch.tensor(DTU_SIZE)).tolist()
    is_dtu = all(0.4 < c < 0.6 for c in center)
    size = torch.tensor([DTU_SIZE], dtype=torch.float64).expand(len(paths), 2).clone()
    if not is_dtu:
        notes.append(
            "The principal point is not that of a 1600 x 1200 image: K is taken to be for the files' own size."
        )
        size = implied_size(intrinsics, files_size(paths), _other_sizes(path), source, notes)
    standard = is_dtu and rows == list(range(DTU_VIEWS))
    notes.append(
        "Split rule: PixelNeRF's views (train 25 22 28 40 44 48 0 8 13, 15 excluded, 25 test)."
        if standard
        else splits.EVERY_8TH
    )
    placed = cameras_for_files(intrinsics, size, poses, paths, names, source, notes)
    return Capture(
        scene_id=path.resolve().name,
        dataset="dtu",
        names=names,
        paths=paths,
        cameras=placed.cameras,
        upright=placed.upright,
        masks=_masks(path, paths, notes),
        depth_bounds=_sphere_bounds(arrays.get(f"scale_mat_{rows[0]}"), placed.cameras.camera_from_world),
        splits=splits.dtu(view_counts) if standard else splits.every_8th(len(paths), view_counts),
        notes=notes,
    )


def decompose_projection(projection: Tensor) -> tuple[Tensor, Tensor]:
    """P = s K [R | t] (N, 3, 4) -> K (N, 3, 3) with positive focal lengths and K_33 = 1, world_from_camera (N, 4, 4).

    RQ decomposition (Hartley and Zisserman, Multiple View Geometry, 2nd ed., A4.1.1) by a QR of the reversed transpose.
    """
    m = projection[:, :, :3]
    projection = projection * torch.linalg.det(m).sign()[:, None, None]  # P and -P are the same camera; det R = +1
    m = projection[:, :, :3]
    q, r = torch.linalg.qr(m.flip(1).transpose(1, 2))
    k, rotation = r.transpose(1, 2).flip(1, 2), q.transpose(1, 2).flip(1)
    signs = torch.diagonal(k, dim1=1, dim2=2).sign()
    k, rotation = k * signs[:, None], rotation * signs[..., None]
    pose = torch.eye(4, dtype=projection.dtype).repeat(len(projection), 1, 1)
    pose[:, :3, :3] = rotation
    pose[:, :3, 3:] = torch.linalg.solve(k, projection[:, :, 3:])
    k = k / k[:, 2:, 2:]
    k[:, 0, 1] = k[:, 2, 1] = k[:, 1, 0] = k[:, 2, 0] = 0  # rounding only
    return k, from_camera_from_world(pose)


def _camera_file(path: Path) -> Path | None:
    return next((path / f for f in CAMERA_FILES if (path / f).is_file()), None)


def _rows(paths: list[Path], arrays: dict[str, np.ndarray], source: Path, notes: list[str]) -> dict[Path, int]:
    """Which camera each image has, those without one left out."""
    keys = sorted(int(k.removeprefix("world_mat_")) for k in arrays if k.removeprefix("world_mat_").isdigit())
    if not keys:
        load_arrays(source, ["world_mat_0"])  # says what is lacking
    by_number = rows_by_number([p.stem for p in paths], keys, from_zero=True)
    fits = by_number is not None and None not in by_number
    if len(paths) == len(keys) and not fits:
        if by_number is not None:
            notes.append("The numbers in the images' names are not those of the cameras: both were taken in order.")
        return dict(zip(paths, keys, strict=True))
    if by_number is None:
        raise InputError(
            f"{source} has {len(keys)} cameras for {len(paths)} images, and the names of the images don't tell which "
            "belongs to which; number them as the cameras are (000000.png has world_mat_0)."
        )
    given = {path: row for path, row in zip(paths, by_number, strict=True) if row is not None}
    without = [p.name for p in paths if p not in given]
    idle = sorted(set(keys) - set(given.values()))
    if not given:
        raise InputError(f"No image of {paths[0].parent} has the number of a camera of {source} ({keys[0]}, ...).")
    if without:
        notes.append(unlisted_note(len(without), "images without a camera were", without))
    if idle:
        idle_names = [f"world_mat_{i}" for i in idle]
        notes.append(unlisted_note(len(idle), "cameras without an image were", idle_names))
    return given


def _masks(path: Path, images: list[Path], notes: list[str]) -> list[Path | None]:
    """The mask of each image: of its name, else of its number."""
    found = list_images(path / "mask") if (path / "mask").is_dir() else []
    if not found:
        return []
    by_stem = {p.stem: p for p in found}
    masks = [by_stem.get(p.stem) for p in images]
    if not any(masks):
        theirs, ours = numbers_in([p.stem for p in found]), numbers_in([p.stem for p in images])
        by_number = dict(zip(theirs, found, strict=True)) if theirs else {}
        masks = [by_number.get(n) for n in ours] if ours else []
    lacking = [p.name for p, mask in zip(images, masks) if mask is None]
    if not any(masks) or not masks:
        notes.append(f"The names of the {len(found)} files in mask/ are not those of images; masks were left out.")
        return []
    if lacking:
        notes.append(f"{len(lacking)} images have no mask in mask/ and count whole: {', '.join(lacking[:12])}.")
    return masks


def _other_sizes(path: Path) -> list[tuple[float, float]]:
    """Sizes of the first image in the scene's other folders, the largest first."""
    folders = [p for p in sorted(path.iterdir()) if p.is_dir() and p.name.startswith(("image", "rgb"))]
    sizes = {image_size(files[0], upright=False) for folder in folders if (files := list_images(folder))}
    return sorted(((float(w), float(h)) for w, h in sizes), reverse=True)


def _sphere_bounds(scale_mat: object, camera_from_world: Tensor) -> Tensor | None:
    """(N, 2) nearest and farthest depth of the object's sphere."""
    if scale_mat is None:
        return None
    matrix = numbers(scale_mat, (4, 4), "scale_mat_0", "cameras")
    depth = (camera_from_world @ matrix[:, 3])[:, 2]
    bounds = torch.stack([depth - matrix[0, 0], depth + matrix[0, 0]], -1)
    return bounds if (bounds[:, 0] > 0).all() else None
