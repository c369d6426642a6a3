"""CO3D: a sequence folder below its category's frame_annotations.jgz, or a folder with gt_cameras.npz (PoseDiffusion).

PyTorch3D cameras: row vectors X_camera = X_world R + T, axes x left, y up, z forward; focal length and principal point
in NDC. ndc_isotropic: units of half the short side; ndc_norm_image_bounds: of half of each side; both from the centre
and with x left, y up.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from flows.errors import InputError
from flows.media.packed import gunzip
from flows.readers import splits
from flows.readers.base import Capture
from flows.readers.matching import Finder, left_out
from flows.readers.parsing import (
    cameras_for_files,
    files_size,
    from_camera_from_world,
    images_in,
    load_arrays,
    numbers,
    pinhole,
    unlisted_note,
)

LOOKS_FOR = "gt_cameras.npz, or frame_annotations.jgz in the folder above (CO3D)"
ANNOTATIONS = "frame_annotations.jgz"
READ_KEYS = {"sequence_name", "frame_number", "frame_timestamp", "image", "mask", "viewpoint"}


def detect(path: Path) -> bool:
    above = path.resolve().parent / ANNOTATIONS
    return (path / "gt_cameras.npz").is_file() or ((path / "images").is_dir() and above.is_file())


def read(path: Path, image_folder: str | None, view_counts: tuple[int, ...]) -> Capture:
    """Frames in sorted order of their names. Split rule as for the other captures: every 8th is held out."""
    capture = _read_npz(path, image_folder) if (path / "gt_cameras.npz").is_file() else _read_annotations(path)
    capture.splits = splits.every_8th(len(capture), view_counts)
    capture.notes.append(splits.EVERY_8TH)
    return capture


def from_pytorch3d(rotation: Tensor, translation: Tensor) -> Tensor:
    """PyTorch3D R (N, 3, 3) and T (N, 3) to world_from_camera (N, 4, 4) with OpenCV axes."""
    flip = torch.tensor([-1.0, -1, 1], dtype=rotation.dtype)
    out = torch.eye(4, dtype=rotation.dtype).repeat(len(rotation), 1, 1)
    out[:, :3, :3] = flip[:, None] * rotation.transpose(1, 2)
    out[:, :3, 3] = flip * translation
    return from_camera_from_world(out)


def _read_npz(path: Path, image_folder: str | None) -> Capture:
    source = path / "gt_cameras.npz"
    folder = image_folder or ("images" if (path / "images").is_dir() else ".")
    paths = images_in(path / folder, path)
    names = [p.name for p in paths]
    count = len(paths)
    arrays = load_arrays(source, ["gtR", "gtT", "gtFL"])
    if len(arrays["gtR"]) != count:
        raise InputError(
            f"{source} has {len(arrays['gtR'])} cameras (gtR) for the {count} images of {path / folder}; it says "
            "nothing of their names, so there must be one for each image, in sorted order. Remove images "
            "without a camera."
        )
    rotation = numbers(arrays["gtR"], (count, 3, 3), "gtR (one rotation per image)", source)
    translation = numbers(arrays["gtT"], (count, 3), "gtT (one translation per image)", source)
    focal = numbers(arrays["gtFL"], (count, 2), "gtFL (two focal lengths per image)", source)
    size = files_size(paths).double()
    intrinsics = torch.stack([_intrinsics(f, [0.0, 0.0], s, "ndc_isotropic") for f, s in zip(focal, size, strict=True)])
    notes: list[str] = []
    unused = sorted(set(load_arrays(source, [])) - {"gtR", "gtT", "gtFL"})
    if unused:
        notes.append(f"Of the arrays of {source.name} these are not used: {', '.join(unused)}.")
    placed = cameras_for_files(intrinsics, size, from_pytorch3d(rotation, translation), paths, names, source, notes)
    return Capture(
        path.resolve().name, "co3d", names, paths, cameras=placed.cameras, upright=placed.upright, notes=notes
    )


def _read_annotations(path: Path) -> Capture:
    sequence, category = path.resolve(), path.resolve().parent
    root, source = category.parent, category / ANNOTATIONS
    frames = sorted(_annotated_frames(source, sequence.name), key=lambda f: f["image"]["path"])
    finder = Finder(root, source)
    files = dict(zip(map(id, frames), finder.find_all([f["image"]["path"] for f in frames]), strict=True))
    present = [f for f in frames if files[id(f)] is not None]
    missing = [f["image"]["path"] for f in frames if files[id(f)] is None]
    if not present:
        raise InputError(f"{source} lists {len(frames)} frames of {sequence.name}, but none of their images exists.")
    notes = [unlisted_note(len(missing), "frames whose image is missing were", missing)] if missing else []
    paths = [path for path in files.values() if path is not None]
    beside = left_out(sequence / "images", paths, root) if (sequence / "images").is_dir() else []
    if beside:
        notes.append(unlisted_note(len(beside), "images that no frame names were", beside))
    notes += [*finder.notes(), *_ignored(present, category)]
    names = [p.name for p in paths]
    views = [f["viewpoint"] for f in present]
    size = torch.tensor([f["image"]["size"][::-1] for f in present], dtype=torch.float64)
    intrinsics = torch.stack(
        [
            _intrinsics(v["focal_length"], v["principal_point"], s, v.get("intrinsics_format", "ndc_norm_image_bounds"))
            for v, s in zip(views, size, strict=True)
        ]
    )
    rotation = numbers([v["R"] for v in views], (len(views), 3, 3), "R", source)
    translation = numbers([v["T"] for v in views], (len(views), 3), "T", source)
    placed = cameras_for_files(intrinsics, size, from_pytorch3d(rotation, translation), paths, names, source, notes)
    mask_names = [(f.get("mask") or {}).get("path") for f in present]
    masks = [finder.find_all([m])[0] if m else None for m in mask_names]
    lacking = [n for n, m in zip(mask_names, masks, strict=True) if m is None]
    if len(lacking) == len(masks):
        masks = []
    elif lacking:
        notes.append(f"{len(lacking)} of {len(masks)} frames have no mask and count whole.")
    return Capture(
        scene_id=f"{category.name}_{sequence.name}",
        dataset="co3d",
        names=names,
        paths=paths,
        cameras=placed.cameras,
        upright=placed.upright,
        masks=masks,
        missing=missing,
        notes=notes,
    )


def _ignored(frames: list[dict[str, Any]], category: Path) -> list[str]:
    """One note on what the annotations have beside cameras, images and masks."""
    unused = sorted({key for f in frames for key in f if f[key]} - READ_KEYS)
    lists = sorted(p.name for p in (category / "set_lists").glob("*.json")) if (category / "set_lists").is_dir() else []
    lists += [f.name for f in (category / "set_lists.json", category / "eval_batches") if f.exists()]
    return [f"Of CO3D's annotations these are not used: {', '.join([*unused, *lists])}."] if unused or lists else []


def _annotated_frames(source: Path, sequence: str) -> list[dict[str, Any]]:
    try:
        content = json.loads(gunzip(source))
    except InputError:
        raise
    except (ValueError, RecursionError) as error:
        raise InputError(f"{source} is not a gzipped JSON file ({error}); download it again.") from None
    frames = [f for f in content if f.get("sequence_name") == sequence]
    if not frames:
        raise InputError(f"{source} has no frame of the sequence {sequence}.")
    for frame in frames:
        view, image = frame.get("viewpoint") or {}, frame.get("image") or {}
        lacking = [k for k in ("R", "T", "focal_length", "principal_point") if k not in view]
        lacking += [f"image.{k}" for k in ("path", "size") if k not in image]
        if lacking:
            raise InputError(f"{source}: frame {frame.get('frame_number')} of {sequence} has no {lacking[0]}.")
    return frames


def _intrinsics(focal: Any, principal: Any, size: Tensor, convention: str) -> Tensor:
    """K in pixels from PyTorch3D's NDC; size (2) width, height."""
    half = size / 2
    if convention not in ("ndc_isotropic", "ndc_norm_image_bounds"):
        raise InputError(
            f"CO3D intrinsics_format {convention} is unknown; expected ndc_isotropic or ndc_norm_image_bounds."
        )
    unit = half.min().expand(2) if convention == "ndc_isotropic" else half
    f = torch.as_tensor(focal, dtype=torch.float64) * unit
    c = half - torch.as_tensor(principal, dtype=torch.float64) * unit
    return pinhole(float(f[0]), float(f[1]), float(c[0]), float(c[1]))
