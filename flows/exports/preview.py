"""The splats that a browser draws while the camera moves, kept beside the store once they are made."""

from __future__ import annotations

import os
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from cat3d_core.cameras import Cameras
from cat3d_core.reconstruction import Reconstructor
from cat3d_core.splats import Gaussians, Splats
from cat3d_core.splats.viewpoints import between
from flows.exports.splats import splats_of
from flows.progress import meter
from schemas.scene_store import Run, SceneStore

MOST = 100_000
"""3.2 MB for the browser."""
VIEWS, SIDE, STEPS = 48, 96, 200
"""Cameras that are rendered for it, the longer side of what they see, in pixels, and steps of refinement: about a
minute of one core for a field of the preset fast."""
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
        with safe_open(path, "pt") as file:
            if (file.metadata() or {}).get("key") != key:
                return None
            return Gaussians.from_tensors({name: file.get_tensor(name) for name in file.keys()})  # noqa: SIM118
    except (SafetensorError, OSError, ValueError):
        return None  # a damaged one is made again


def make_preview(store: SceneStore, run: Run, scene: Reconstructor, cameras: Cameras) -> Gaussians:
    """Splats of a reconstruction from what some of the cameras (scene frame) see; those of a finished one are kept."""
    if isinstance(scene, Splats):
        splats = splats_of(scene, [], cameras, MOST)
    else:
        some = between(cameras, VIEWS)
        scales = [min(1.0, SIDE / float(size.max())) for size in some.size]
        some = Cameras.cat([some[i].resize(*_scaled(some.size[i], scale)) for i, scale in enumerate(scales)])
        some = some.to(dtype=torch.float32)
        renders = []
        with meter(f"splats of {store.scene_id} {run.name}", len(some)) as progress:
            for i in range(len(some)):
                render = scene.render(some, i)
                renders.append(type(render)(**{name: value.cpu() for name, value in vars(render).items()}))
                progress.advance()
        splats = splats_of(scene, renders, some, MOST, STEPS)
    key = _key(store, run)
    if key is not None:
        path = preview_path(store, run)
        path.parent.mkdir(parents=True, exist_ok=True)
        part = path.with_suffix(f".{os.getpid()}.part")
        tensors = {name: value.contiguous() for name, value in splats.tensors().items()}
        save_file(tensors, part, metadata={"key": key})
        os.replace(part, path)
    return splats


def _scaled(size: torch.Tensor, scale: float) -> tuple[int, int]:
    width, height = (max(1, round(float(side) * scale)) for side in size)
    return width, height


def _key(store: SceneStore, run: Run) -> str | None:
    """What the splats depend on: None for a reconstruction that is not finished, of which nothing is kept."""
    record = store.record("reconstruct", run.name)
    return None if record is None else f"{VERSION} {record.key}"
