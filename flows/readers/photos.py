"""A plain folder of photos (or one photo): no cameras; their poses are estimated later."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from flows.errors import InputError
from flows.media.files import RAW, VIDEOS, image_size, is_image, list_images
from flows.readers import splits
from flows.readers.base import Capture
from flows.readers.matching import check_link, images_below
from flows.readers.parsing import images_in, load_json, unlisted_note

#: Beside a photo that a text made: `flows/generation/text.py` writes it.
PROMPT_SETTINGS = "prompt.json"
LOOKS_FOR = "a folder with image files (or folders of them), or one image file"
# Folders whose images are no photos of the scene.
NOT_PHOTOS = ("mask", "depth", "normal", "thumb", "seg", "semantic", "label")


def detect(path: Path) -> bool:
    return is_image(path) if path.is_file() else bool(list_images(path)) or any(_folders(path).values())


def read(path: Path, image_folder: str | None, view_counts: tuple[int, ...]) -> Capture:
    """All images of the folder in sorted order. Every header is looked at, so that an unreadable file is named now.

    Photos are those of `image_folder`, else those of the folder itself, else those of its only subfolder with photos or
    of images/, else those of all subfolders where no two have the same name.
    """
    notes: list[str] = []
    if path.is_file():
        root, paths = path.parent, [path]
    elif image_folder:
        root, paths = path / image_folder, images_in(path / image_folder, path)
    else:
        root, paths = _photos(path, notes)
    if not path.is_file():
        notes += _left_out(root, paths)
    for file in paths:
        image_size(file)
    few = "Too few photos to hold any out: all are training views."
    made_from = _made_from(path)
    if made_from is not None:
        how = f"the pipeline {made_from['pipeline_class']} (sha256 {made_from['pipeline_sha256'][:16]})"
        notes.append(f"The photo was made from the text “{made_from['text']}” by {how}, seed {made_from['seed']}.")
    return Capture(
        scene_id=path.resolve().stem if path.is_file() else path.resolve().name,
        dataset="photos",
        names=[str(p.relative_to(root)) for p in paths],
        paths=paths,
        splits=splits.every_8th(len(paths), view_counts),
        notes=[*notes, splits.EVERY_8TH if len(paths) >= 4 else few],
        made_from=made_from,
    )


def _photos(path: Path, notes: list[str]) -> tuple[Path, list[Path]]:
    """The folder that names are relative to, and the photos."""
    folders = _folders(path)
    own = list_images(path)
    if own:
        others = [f"{f.name} ({len(images)})" for f, images in folders.items() if images]
        if others:
            notes.append(
                f"The photos are those of the folder itself; images in subfolders were left out: {', '.join(others)}. "
                "--images NAME takes a subfolder instead."
            )
        return path, images_in(path, path)
    photos = {f: images for f, images in folders.items() if images and not _no_photos(f)}
    photos = photos or {f: images for f, images in folders.items() if images}
    if not photos:
        raise InputError(f"{path} holds no images; put the photos there.")
    chosen = path / "images" if path / "images" in photos else next(iter(photos))
    stems = [p.relative_to(f).with_suffix("") for f, images in photos.items() for p in images]
    if chosen.name != "images" and len(photos) > 1:
        if len(set(stems)) < len(stems):
            counts = ", ".join(f"{f.name} ({len(images)})" for f, images in photos.items())
            raise InputError(
                f"{path} has images of the same names in several folders: {counts}; choose one with --images NAME, or "
                "put all photos into one folder."
            )
        paths = sorted(p for images in photos.values() for p in images)
        notes.append(f"The photos are those of {len(photos)} folders: {', '.join(f.name for f in photos)}.")
        root = path
    else:
        root, paths = chosen, photos[chosen]
        notes += [f"The photos are those of {chosen.name}."] if chosen.name != "images" else []
    for file in paths:
        check_link(file, path)
    others = [f"{f.name} ({len(images)})" for f, images in folders.items() if images and images[0] not in paths]
    if others:
        notes.append(f"Images in other folders were left out: {', '.join(others)}; --images NAME takes them instead.")
    return root, paths


def _folders(path: Path) -> dict[Path, list[Path]]:
    """Subfolders with the images in and below each."""
    if not path.is_dir():
        return {}
    below = sorted(p for p in path.iterdir() if p.is_dir() and not p.name.startswith("."))
    return {folder: images_below(folder) for folder in below}


def _no_photos(folder: Path) -> bool:
    return folder.name.lower().startswith(NOT_PHOTOS)


def _left_out(root: Path, paths: list[Path]) -> list[str]:
    """A note on files beside the photos that one might take for photos: videos, and kinds that cannot be read."""
    beside = [p for p in sorted(root.iterdir()) if p.is_file() and p not in paths and not p.name.startswith(".")]
    kinds = VIDEOS | RAW | {"svg", "pdf", "psb", "xcf", "ai", "eps", "insp", "insv", "360"}
    unread = [p.name for p in beside if p.suffix[1:].lower() in kinds]
    return [unlisted_note(len(unread), "files that are no photos were", unread)] if unread else []


def _made_from(path: Path) -> dict[str, Any] | None:
    """Settings of the text that made the photo of a folder; None for photographs. Raises InputError for a damaged
    record."""
    file = path / PROMPT_SETTINGS
    if not file.is_file():
        return None
    document = load_json(file)
    settings = document.get("settings") if isinstance(document, dict) else None
    needed = ("text", "seed", "pipeline_class", "pipeline_sha256")
    if not isinstance(settings, dict) or any(name not in settings for name in needed):
        raise InputError(f"{file} is not the record of a text that made a photo; remove it to read the photo alone.")
    return settings
