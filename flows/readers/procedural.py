"""Procedural scenes by name: procedural:FAMILY/SEED, rendered by `cat3d_core.synthetic` with its true depth.

Optional settings follow a question mark: procedural:llff/3?views=24&width=128&height=96.
"""

from __future__ import annotations

import re
from functools import lru_cache
from pathlib import Path
from urllib.parse import parse_qsl

import numpy as np

from cat3d_core.cameras import Cameras
from cat3d_core.synthetic import Traced, random_cameras, random_scene, trace
from flows.images import to_uint8
from flows.readers import splits
from flows.readers.base import Capture, InputError

LOOKS_FOR = "the spec procedural:FAMILY/SEED instead of a folder"
PATTERN = re.compile(r"procedural:([a-z0-9]+)/(\d{1,9})(?:\?(.*))?")
SETTINGS = {"views": 24, "width": 128, "height": 128}
LARGEST = {"views": 1000, "width": 2048, "height": 2048}
# The core's names of the families, where the data set's full name differs.
FAMILY_NAMES = {"re10k": "realestate10k", "mip360": "mipnerf360"}


def detect(path: Path) -> bool:
    """Never a folder: `read_capture` knows the spec by its prefix."""
    return False


def read(path: Path | str, image_folder: str | None, view_counts: tuple[int, ...]) -> Capture:
    """Render the scene. Every 8th view is held out. Raises InputError for an unknown family or setting."""
    match = PATTERN.fullmatch(str(path))
    if not match:
        raise InputError(f"{path} is not of the form procedural:FAMILY/SEED, for example procedural:llff/3.")
    family, seed, settings = match.group(1), int(match.group(2)), _settings(str(path), match.group(3) or "")
    try:
        cameras, traced = _traced(family, seed, **settings)
    except ValueError as error:
        raise InputError(f"{path}: {error}") from None
    return Capture(
        scene_id=f"procedural_{family}_{seed}",
        dataset=FAMILY_NAMES.get(family, family),
        names=[f"{i:04d}" for i in range(len(cameras))],
        images=[to_uint8(t.image[0].permute(1, 2, 0)) for t in traced],
        cameras=cameras,
        depths=[t.depth[0].cpu().numpy().astype(np.float32) for t in traced],
        splits=splits.every_8th(len(cameras), view_counts),
        notes=[splits.EVERY_8TH],
    )


@lru_cache(maxsize=2)  # a spec never changes its meaning, and several stages of a run read it
def _traced(family: str, seed: int, views: int, width: int, height: int) -> tuple[Cameras, list[Traced]]:
    scene = random_scene(family, seed)
    cameras = random_cameras(scene, seed, views, width, height)
    # View by view: a batch of all views at once needs memory for all their rays.
    return cameras, [trace(scene, cameras, view) for view in range(len(cameras))]


def _settings(spec: str, query: str) -> dict[str, int]:
    settings = dict(SETTINGS)
    for key, value in parse_qsl(query, keep_blank_values=True):
        if key not in settings:
            raise InputError(f'{spec}: there is no setting "{key}"; the settings are {", ".join(SETTINGS)}.')
        if not value.isdigit() or not 1 <= int(value) <= LARGEST[key]:
            raise InputError(f"{spec}: {key} must be a whole number from 1 to {LARGEST[key]}.")
        settings[key] = int(value)
    return settings
