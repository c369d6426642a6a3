"""Procedural scenes by name: procedural:FAMILY/SEED, rendered by `cat3d_core.synthetic`."""

from __future__ import annotations

from pathlib import Path

from flows.readers.base import Capture, InputError

LOOKS_FOR = "the spec procedural:FAMILY/SEED instead of a folder"


def detect(path: Path) -> bool:
    return False


def read(path: Path | str, image_folder: str | None, view_counts: tuple[int, ...]) -> Capture:
    raise InputError(f"{path}: procedural scenes are not available in this build.")
