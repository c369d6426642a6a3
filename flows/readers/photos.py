"""A plain folder of photos (or one photo): no cameras; their poses are estimated later."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from flows.errors import InputError
from flows.media.images import image_size, list_images
from flows.readers import splits
from flows.readers.base import Capture
from flows.readers.parsing import images_in, load_json

#: Beside a photo that a text made: `flows/generation/text.py` writes it.
PROMPT_SETTINGS = "prompt.json"
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
    notes = [splits.EVERY_8TH] if len(paths) >= 4 else ["Too few photos to hold any out: all are training views."]
    made_from = _made_from(path)
    if made_from is not None:
        how = f"the pipeline {made_from['pipeline_class']} (sha256 {made_from['pipeline_sha256'][:16]})"
        notes.append(f"The photo was made from the text “{made_from['text']}” by {how}, seed {made_from['seed']}.")
    return Capture(
        scene_id=path.resolve().stem if path.is_file() else path.resolve().name,
        dataset="photos",
        names=[p.name for p in paths],
        paths=paths,
        splits=splits.every_8th(len(paths), view_counts),
        notes=notes,
        made_from=made_from,
    )


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
