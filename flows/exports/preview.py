"""The splats that a browser draws while the camera moves, kept beside the store once they are made."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from safetensors.torch import save

from cat3d_core.cameras import Cameras
from cat3d_core.reconstruction import Reconstructor
from cat3d_core.splats import Gaussians, Splats
from cat3d_core.splats.viewpoints import between
from cat3d_core.weights_file import read_weights
from flows.exports.splats import splats_of
from flows.progress import meter
from schemas.documents import write_bytes
from schemas.scene_store import Run, SceneStore

MOST = 100_000
"""3.2 MB for the browser."""


@dataclass(frozen=True)
class Effort:
    """views: cameras that are rendered; side: of what they see, the longer one, in pixels; steps: of refinement."""

    views: int
    side: int
    steps: int


FINISHED = Effort(48, 96, 200)
"""About a minute of one core for a field of the preset fast."""
UNDER_WAY = Effort(24, 48, 0)
"""Some seconds, as another one follows with the next checkpoint of the training, which needs the core itself."""
VERSION = 1


def preview_path(store: SceneStore, run: Run) -> Path:
    """Where the splats of a run are kept."""
    return store.folder.parent / ".work" / f"{store.scene_id}-{run.name}-splats.safetensors"


def kept_preview(store: SceneStore, run: Run) -> Gaussians | None:
    """The splats of the run's finished reconstruction, where they are made already."""
    path, key = preview_path(store, run), _key(store, run)
    if key is None or not path.exists():
        return None
    try:
        metadata, tensors = read_weights(path)
        return Gaussians.from_tensors(tensors) if metadata.get("key") == key else None
    except (OSError, ValueError):
        return None  # a damaged one is made again


def make_preview(
    store: SceneStore, run: Run, scene: Reconstructor, cameras: Cameras, before_each: Callable[[], object] = bool
) -> Gaussians:
    """Splats of a reconstruction from what some of the cameras (scene frame) see; those of a finished one are kept.

    `before_each` is called before each view and step; it may wait, or raise to end the work.
    """
    key = _key(store, run)
    if isinstance(scene, Splats):
        splats = splats_of(scene, [], cameras, MOST)
    else:
        effort = UNDER_WAY if key is None else FINISHED
        some = between(cameras, effort.views)
        some = Cameras.cat([within(some[i], effort.side) for i in range(len(some))]).to(dtype=torch.float32)
        renders = []
        with meter(f"splats of {store.scene_id} {run.name}", len(some)) as progress:
            for i in range(len(some)):
                before_each()
                render = scene.render(some, i)
                renders.append(type(render)(**{name: value.cpu() for name, value in vars(render).items()}))
                progress.advance()
        splats = splats_of(scene, renders, some, MOST, effort.steps, before_each)
    if key is not None:
        path = preview_path(store, run)
        path.parent.mkdir(parents=True, exist_ok=True)
        tensors = {name: value.contiguous() for name, value in splats.tensors().items()}
        write_bytes(path, save(tensors, {"key": key}))
    return splats


def within(camera: Cameras, side: int) -> Cameras:
    """One camera with the longer side of its image at most so many pixels."""
    width, height = (int(length) for length in camera.size[0])
    shrink = min(1.0, side / max(width, height))
    return camera.resize(max(1, round(width * shrink)), max(1, round(height * shrink)))


def _key(store: SceneStore, run: Run) -> str | None:
    """What the splats depend on: None for a reconstruction that is not finished, of which nothing is kept."""
    record = store.record("reconstruct", run.name)
    return None if record is None else f"{VERSION} {record.key}"
