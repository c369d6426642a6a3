"""COLMAP models, binary and text, beside a folder of images; sparse points are kept."""

from __future__ import annotations

import re
from pathlib import Path

import torch

from flows.errors import InputError
from flows.readers import splits
from flows.readers.base import Capture
from flows.readers.colmap_model import Model, ModelImage, has_model, load_model
from flows.readers.lenses import lens_of, stacked
from flows.readers.matching import Finder, check_link, left_out
from flows.readers.parsing import cameras_for_files, family_of, from_camera_from_world, unlisted_note

LOOKS_FOR = "sparse/0, sparse, or colmap/sparse/0 with cameras.bin or cameras.txt (COLMAP)"
MODEL_FOLDERS = ("sparse", "colmap/sparse", ".")
IMAGE_FOLDERS = ("images", "input", "images_2", "images_4", "images_8", ".")


def detect(path: Path) -> bool:
    return path.is_dir() and bool(_model_folders(path))


def read(path: Path, image_folder: str | None, view_counts: tuple[int, ...]) -> Capture:
    """Registered images in sorted order of their names; those whose file is missing are reported and left out.

    Of several models the one with most images is taken. `path` may also be the folder of one model.
    """
    folders = _model_folders(path)
    if not folders:
        raise InputError(
            f"{path} has no COLMAP model; looked for cameras.bin or .txt in sparse/0, {', '.join(MODEL_FOLDERS)}."
        )
    notes: list[str] = []
    model = _largest([load_model(folder) for folder in folders], notes)
    if not model.images:
        raise InputError(f"The COLMAP model {model.folder} has no registered image.")
    root, folder, files = _image_files(path, model, image_folder)
    notes += [*model.notes, *folder.notes()]
    found = sorted(files.items(), key=lambda item: item[0].name)
    missing = sorted(im.name for im in model.images if im not in files)
    if missing:
        notes.append(unlisted_note(len(missing), "registered images without a file were", missing))
    paths = [file for _, file in found]
    unregistered = left_out(folder.root, paths, root) if folder.root != root else []
    if unregistered:
        notes.append(
            unlisted_note(
                len(unregistered), f"photos of the folder {folder.root.name} have no pose and were", unregistered
            )
        )
    if folder.root.name != "images" and folder.root != root:
        notes.append(f"Images are those of {folder.root.name}; --images takes another folder.")
    names = [image.name.replace("\\", "/") for image, _ in found]
    used = [model.cameras[image.camera_id] for image, _ in found]
    intrinsics, distortion, fisheye = stacked([lens_of(c.model, c.params, model.folder) for c in used])
    size = torch.tensor([[c.width, c.height] for c in used], dtype=torch.float64)
    poses = from_camera_from_world(torch.stack([image.camera_from_world for image, _ in found]))
    placed = cameras_for_files(intrinsics, size, poses, paths, names, model.folder, notes)
    return Capture(
        scene_id=_scene_name(path, root, model),
        dataset=family_of(root),
        names=names,
        paths=paths,
        cameras=placed.cameras,
        upright=placed.upright,
        distortion=distortion,
        fisheye=fisheye,
        points=torch.as_tensor(model.points) if len(model.points) else None,
        splits=splits.every_8th(len(names), view_counts),
        missing=missing,
        notes=[*notes, splits.EVERY_8TH],
    )


def _largest(models: list[Model], notes: list[str]) -> Model:
    """The model with most images, the first of equals; a note names the others."""
    best = max(models, key=lambda m: len(m.images))
    others = [f"{m.folder.name} ({len(m.images)} images)" for m in models if m is not best]
    if others:
        notes.append(
            f"Of {len(models)} COLMAP models {best.folder.name} was taken, which has most images ({len(best.images)}); "
            f"left out: {', '.join(others)}. To take one of those give its folder as the scene, such as "
            f"{next(m.folder for m in models if m is not best)}."
        )
    return best


def _image_files(path: Path, model: Model, image_folder: str | None) -> tuple[Path, Finder, dict[ModelImage, Path]]:
    """The scene's folder, the image folder with most of the model's images (the first of equals), and their files."""
    roots = [path]
    if model.folder == path:  # the folder of a model: the images lie beside it or above
        roots += list(path.absolute().parents)[:3]
    folders = (image_folder,) if image_folder else IMAGE_FOLDERS
    names = [image.name for image in model.images]
    candidates = []
    for root in roots:
        for name in folders:
            if (root / name).is_dir():
                check_link(root / name, root)
                finder = Finder(root if name == "." else root / name, model.folder)
                found = finder.find_all(names)
                files = {im: file for im, file in zip(model.images, found, strict=True) if file is not None}
                candidates.append((root, finder, files))
        if any(files for _, _, files in candidates):
            return max(candidates, key=lambda c: len(c[2]))
    raise InputError(
        f"None of the {len(names)} images of the COLMAP model {model.folder} (first: {min(names)}) is in "
        f"{path} / {', '.join(folders)}; put the images there, or name their folder with --images."
    )


def _scene_name(path: Path, root: Path, model: Model) -> str:
    """The scene folder's name, with that of the model behind it where it was asked for by its own folder."""
    if root == path:
        return root.resolve().name
    return "_".join([root.resolve().name, *model.folder.resolve().relative_to(root.resolve()).parts])


def _model_folders(path: Path) -> list[Path]:
    """Folders with a model, those numbered by the mapper in order."""
    for name in MODEL_FOLDERS:
        folder = path / name
        numbered = (
            [p for p in folder.iterdir() if p.is_dir() and has_model(p)] if folder.is_dir() and name != "." else []
        )
        numbered.sort(key=lambda p: [int(t) if t.isdigit() else t for t in re.split(r"(\d+)", p.name)])
        found = [*numbered, *([folder] if has_model(folder) else [])]
        if found:
            return found if name != "." else [path]
    return []
