"""DTU as preprocessed by IDR and NeuS: image/, mask/, cameras_sphere.npz (or cameras.npz).

world_mat_i = K [R | t], world to pixels of the original 1600 x 1200 image, OpenCV axes, millimetres. scale_mat_i maps
the unit sphere to the object's sphere in the world. NeuS's BlendedMVS scenes have the same layout at their own size.
"""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from flows.errors import InputError
from flows.media.images import image_size, list_images
from flows.readers import splits
from flows.readers.base import Capture
from flows.readers.parsing import cameras_for_files, from_camera_from_world, images_in, load_arrays, numbers

LOOKS_FOR = "cameras_sphere.npz or cameras.npz beside image/ (DTU, IDR/NeuS)"
CAMERA_FILES = ("cameras_sphere.npz", "cameras.npz", "cameras_large.npz")
DTU_SIZE = (1600, 1200)
DTU_VIEWS = 49


def detect(path: Path) -> bool:
    return _camera_file(path) is not None


def read(path: Path, image_folder: str | None, view_counts: tuple[int, ...]) -> Capture:
    """View i is the i-th image in sorted order. Near and far are those of the object's sphere, when it is in front."""
    source = _camera_file(path)
    if source is None:
        raise InputError(f"{path} has none of {', '.join(CAMERA_FILES)}; it is not a DTU scene.")
    folder = image_folder or next((f for f in ("image", "images", "rgb") if (path / f).is_dir()), "image")
    paths = images_in(path / folder, path)
    names = [p.name for p in paths]
    arrays = load_arrays(source, [f"world_mat_{i}" for i in range(len(paths))])
    extra = load_arrays(source, [])
    matrices = torch.stack(
        [numbers(arrays[f"world_mat_{i}"], (4, 4), f"world_mat_{i}", source)[:3] for i in range(len(paths))]
    )
    for name, matrix in zip(names, matrices, strict=True):
        if not matrix.isfinite().all() or abs(float(torch.linalg.det(matrix[:, :3]))) < 1e-12:
            raise InputError(
                f"{source}: the projection matrix of view {name} is NaN or singular; correct or remove it."
            )
    intrinsics, poses = decompose_projection(matrices)
    notes: list[str] = []
    center = (intrinsics[:, :2, 2].mean(0) / torch.tensor(DTU_SIZE)).tolist()
    is_dtu = all(0.4 < c < 0.6 for c in center)
    if not is_dtu:
        notes.append(
            "The principal point is not that of a 1600 x 1200 image: K is taken to be for the files' own size."
        )
    size = torch.tensor([DTU_SIZE if is_dtu else image_size(p) for p in paths], dtype=torch.float64)
    standard = is_dtu and len(paths) == DTU_VIEWS
    notes.append(
        "Split rule: PixelNeRF's views (train 25 22 28 40 44 48 0 8 13, 15 excluded, 25 test)."
        if standard
        else splits.EVERY_8TH
    )
    cameras = cameras_for_files(intrinsics, size, poses, paths, names, source, notes)
    return Capture(
        scene_id=path.resolve().name,
        dataset="dtu",
        names=names,
        paths=paths,
        cameras=cameras,
        masks=_masks(path, len(paths), notes),
        depth_bounds=_sphere_bounds(extra.get("scale_mat_0"), cameras.camera_from_world),
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


def _masks(path: Path, count: int, notes: list[str]) -> list[Path | None]:
    found = list_images(path / "mask") if (path / "mask").is_dir() else []
    if found and len(found) != count:
        notes.append(f"mask/ has {len(found)} files for {count} images; masks were left out.")
        return []
    return list(found)


def _sphere_bounds(scale_mat: object, camera_from_world: Tensor) -> Tensor | None:
    """(N, 2) nearest and farthest depth of the object's sphere."""
    if scale_mat is None:
        return None
    matrix = numbers(scale_mat, (4, 4), "scale_mat_0", "cameras")
    depth = (camera_from_world @ matrix[:, 3])[:, 2]
    bounds = torch.stack([depth - matrix[0, 0], depth + matrix[0, 0]], -1)
    return bounds if (bounds[:, 0] > 0).all() else None
