"""A plain folder of photos (or one photo): no cameras; their poses are estimated later."""

from __future__ import annotations

from pathlib import Path

from flows.errors import InputError
from flows.media.images import image_size, list_images
from flows.readers import splits
from flows.readers.base import Capture
from flows.readers.parsing import images_in

LOOKS_FOR = "a folder with image files (or images/ with image files), or one image file"


def detect(path: Path) -> bool:
    return (
        path.is_file() or bool(list_images(path)) or ((path / "images").is_dir() and bool(list_images(path / "images")))
    )


def read(path: Path, image_folder: str | None, view_counts: tuple[int, ...]) -> Capture:
    """All images of the folder in sorted order. Every header is looked at, so that an unreadable file is named now."""
    if path.is_file():
        paths = [path]
    elif image_folder:
        paths = images_in(path / image_folder, path)
    else:
        own = path.is_dir() and bool(list_images(path))
        paths = images_in(path if own or not (path / "images").is_dir() else path / "images", path)
    if not paths:
        raise InputError(f"{path} holds no images; put the photos there.")
    for file in paths:
        image_size(file)
    return Capture(
        scene_id=path.resolve().stem if path.is_file() else path.resolve().name,
        dataset="photos",
        names=[p.name for p in paths],
        paths=paths,
        splits=splits.every_8th(len(paths), view_counts),
        notes=[splits.EVERY_8TH] if len(paths) >= 4 else ["Too few photos to hold any out: all are training views."],
    )
