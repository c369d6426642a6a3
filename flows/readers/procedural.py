"""Procedural scenes by name: procedural:FAMILY/SEED, rendered by `cat3d_core.synthetic` with its true depth.

Optional settings follow a question mark: procedural:llff/3?views=24&width=128&height=96. A view is rendered when it is
looked at: to know that a finished run is up to date costs no rendering.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path
from urllib.parse import parse_qsl

import numpy as np

from cat3d_core.cameras import Cameras
from cat3d_core.synthetic import Scene, random_cameras, random_scene, trace
from flows.errors import InputError
from flows.media.images import to_uint8
from flows.readers import splits
from flows.readers.base import Capture
from schemas.content_key import content_key

#: Raise when a spec renders otherwise than before: its images are known by the spec and this, not by their pixels.
VERSION = 1
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
    spec = (family, seed, settings["views"], settings["width"], settings["height"])
    try:
        _, cameras = _scene(spec)
    except ValueError as error:
        raise InputError(f"{path}: {error}") from None
    count = len(cameras)
    return Capture(
        scene_id=f"procedural_{family}_{seed}",
        dataset=FAMILY_NAMES.get(family, family),
        names=[f"{i:04d}" for i in range(count)],
        images=Rendered(count, lambda view: _view(spec, view)[0]),
        image_digests=[content_key(spec=spec, view=view, version=VERSION) for view in range(count)],
        cameras=cameras,
        depths=Rendered(count, lambda view: _view(spec, view)[1]),
        splits=splits.every_8th(count, view_counts),
        notes=[splits.EVERY_8TH],
    )


class Rendered(Sequence[np.ndarray]):
    """One array per view, made when it is asked for."""

    def __init__(self, count: int, render: Callable[[int], np.ndarray]) -> None:
        self._views, self._render = range(count), render

    def __len__(self) -> int:
        return len(self._views)

    def __getitem__(self, view):  # type: ignore[no-untyped-def]
        chosen = self._views[view]
        return [self._render(v) for v in chosen] if isinstance(view, slice) else self._render(chosen)


Spec = tuple[str, int, int, int, int]  # family, seed, views, width, height


@lru_cache(maxsize=8)
def _scene(spec: Spec) -> tuple[Scene, Cameras]:
    family, seed, views, width, height = spec
    scene = random_scene(family, seed)
    return scene, random_cameras(scene, seed, views, width, height)


@lru_cache(maxsize=64)  # a spec never changes its meaning, and several stages of a run look at a view
def _view(spec: Spec, view: int) -> tuple[np.ndarray, np.ndarray]:
    """Image (H, W, 3) uint8 and z-depth (H, W) float32."""
    traced = trace(*_scene(spec), view)
    return to_uint8(traced.image[0].permute(1, 2, 0)), traced.depth[0].cpu().numpy().astype(np.float32)


def _settings(spec: str, query: str) -> dict[str, int]:
    settings = dict(SETTINGS)
    for key, value in parse_qsl(query, keep_blank_values=True):
        if key not in settings:
            raise InputError(f'{spec}: there is no setting "{key}"; the settings are {", ".join(SETTINGS)}.')
        if not value.isdigit() or not 1 <= int(value) <= LARGEST[key]:
            raise InputError(f"{spec}: {key} must be a whole number from 1 to {LARGEST[key]}.")
        settings[key] = int(value)
    return settings
