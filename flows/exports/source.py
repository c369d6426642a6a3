"""A finished run as the exports read it: its reconstruction, cameras and views, and the frame of what is written."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import torch

from cat3d_core.cameras import Cameras
from cat3d_core.normalization import Similarity
from cat3d_core.reconstruction import Reconstructor, Render
from cat3d_core.view_selection import evenly
from flows.errors import InputError
from flows.generation.views import generated_views
from flows.jobs.access import read_cameras, read_images, read_similarity, views_with_role
from flows.progress import meter
from flows.reconstruction.stored import read_reconstruction
from schemas.scene_store import Run, SceneStore

FRAMES = ("world", "scene")
IDENTITY = Similarity(1.0, torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))


@dataclass(frozen=True)
class Source:
    """`frame_from_scene` maps the scene frame (unit distance to the looked-at origin, +z up) to the frame of exports:
    the data set's own world, or the scene frame itself."""

    store: SceneStore
    run: Run
    scene: Reconstructor
    frame_from_scene: Similarity


def open_source(path: Path, run_name: str | None, frame: str) -> Source:
    """Open a run for export. Raises InputError for an unknown frame, an undecided or unfinished run, StoreError for a
    damaged store."""
    if frame not in FRAMES:
        raise InputError(f'There is no frame "{frame}"; choose {" or ".join(FRAMES)}.')
    store = SceneStore.open(path)
    names = store.runs()
    if run_name is None and len(names) != 1:
        known = f"it has the runs {', '.join(names)}; choose one with --run" if names else "it has no run yet"
        raise InputError(f"{path} cannot be exported as it is: {known}.")
    run = store.run(run_name or names[0])
    frame_from_scene = read_similarity(store).inverse() if frame == "world" else IDENTITY
    return Source(store, run, read_reconstruction(store, run), frame_from_scene)


@dataclass(frozen=True)
class PosedImages:
    """Views the field was trained on: cameras (N) in the scene frame; images N x (h, w, 3) uint8, once and one at a
    time; for each its name in the data set, or None for a generated view."""

    cameras: Cameras
    images: Iterable[torch.Tensor]
    captured_name: list[str | None]


def training_images(source: Source) -> PosedImages:
    """The run's captured training views, then its generated views where it has them. Held-out views are left out."""
    store, run = source.store, source.run
    train = views_with_role(store, run, "train")
    cameras, images = [read_cameras(store.captured, train)], []
    names: list[str | None] = [str(name) for name in store.captured.read("name")[train]]
    if "done_image" in run.generated:
        for camera, image, *_ in generated_views(run):
            cameras.append(camera)
            images.append(image)
            names.append(None)
    return PosedImages(Cameras.cat(cameras), chain(read_images(store.captured, train), images), names)


def surface_cameras(source: Source, limit: int) -> Cameras:
    """At most `limit` cameras (scene frame) that see the surface: training views, generated views, the video's path,
    thinned evenly."""
    store, run = source.store, source.run
    cameras = [read_cameras(store.captured, views_with_role(store, run, "train"))]
    if "done_image" in run.generated:
        cameras += [view.camera for view in generated_views(run)]
    if "path" in run.section("renders"):
        cameras.append(read_cameras(run.renders("path")))
    every = Cameras.cat(cameras)
    return every[evenly(len(every), limit)]


def render_views(source: Source, cameras: Cameras, scale: float = 1.0) -> Iterator[Render]:
    """Render each camera (scene frame) at `scale` times its size; tensors on the CPU, one view at a time."""
    with meter(f"render {source.store.scene_id} {source.run.name}", len(cameras)) as progress:
        for index in range(len(cameras)):
            render = source.scene.render(cameras, index, scale)
            yield Render(**{name: value.cpu() for name, value in vars(render).items()})
            progress.advance()
