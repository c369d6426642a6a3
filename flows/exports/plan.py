"""A run's plan for another program: the cameras of the views to make, the given photos, and hints where there are."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from cat3d_core.cameras import Cameras
from cat3d_core.normalization import Similarity
from cat3d_core.plan import Plan
from cat3d_core.reconstruction import Reconstructor
from cat3d_core.warp import warp
from flows.errors import InputError
from flows.exports.dataset import write_colmap, write_transforms
from flows.exports.source import FRAMES, IDENTITY
from flows.generation.imported import view_name
from flows.generation.plan import read_plan
from flows.jobs.access import read_cameras, read_images, read_similarity, views_with_role
from flows.media.images import to_uint8, write_png
from flows.progress import meter
from flows.reconstruction.stored import read_reconstruction
from schemas.scene_store import Run, SceneStore

#: Photos that are warped into a planned view, at most.
NEAREST = 48
_READ_ME = """The views of a plan, to be made by any program.

transforms.json (nerfstudio, OpenGL camera axes) and sparse/0 (COLMAP, text) hold the cameras of the photos in given/
and of {count} planned views, which are to be made: frames of the kind "planned". Make views/{first} to views/{last},
{width} x {height} pixels each, then

    cat3d import-views {store} views --run {run}

hints/, where it is there, holds for each planned view what a reconstruction of the photos alone shows: NAME_depth.npy,
z-depth (float32, H x W, in the unit of the cameras, infinite where nothing is), and NAME.png, the photos carried there
by it (transparent where none shows the place).
"""


@dataclass(frozen=True)
class PlanSource:
    """A run with a plan."""

    store: SceneStore
    run: Run
    plan: Plan
    frame_from_scene: Similarity

    @functools.cached_property
    def scene(self) -> Reconstructor | None:
        """What another or the same run reconstructed from these photos, None where none has."""
        same = [name for name in self.store.runs() if self.store.record("reconstruct", name) is not None
                and np.array_equal(self.store.run(name).read("role"), self.run.read("role"))]  # fmt: skip
        planned = {name for name in same if self.store.record("plan", name) is not None}
        same.sort(key=lambda name: (name in planned, name))  # rather of the photos alone
        return read_reconstruction(self.store, self.store.run(same[0])) if same else None


def open_plan(path: Path, run_name: str | None, frame: str) -> PlanSource:
    """Open a run's plan for export. Raises InputError where there is none, or several to choose among."""
    if frame not in FRAMES:
        raise InputError(f'There is no frame "{frame}"; choose {" or ".join(FRAMES)}.')
    store = SceneStore.open(path)
    planned = [name for name in store.runs() if store.record("plan", name) is not None]
    if run_name is None and len(planned) != 1:
        known = f"the runs {', '.join(planned)} have a plan; choose one with --run" if planned else "no run has a plan"
        raise InputError(f"The plan of {path} cannot be exported: {known}.")
    run = store.run(run_name or planned[0])
    if run.name not in planned:
        raise InputError(f"The run {run.name} of {path} has no plan; make it with `cat3d plan`.")
    plan = read_plan(run.plan, store.captured.shape("size")[0])
    return PlanSource(store, run, plan, read_similarity(store).inverse() if frame == "world" else IDENTITY)


def write_plan_folder(source: PlanSource, folder: Path, store_path: Path) -> int:
    """Write cameras, photos and hints; the number of planned views."""
    train = views_with_role(source.store, source.run, "train")
    cameras, photos = read_cameras(source.store.captured, train), list(read_images(source.store.captured, train))
    names = [f"given/captured_{i:04d}.png" for i in range(len(train))]
    for part in ("given", "views"):
        (folder / part).mkdir(parents=True, exist_ok=True)
    for name, photo in zip(names, photos, strict=True):
        write_png(folder / name, photo.numpy())
    planned = [f"views/{view_name(view)}" for view in range(len(source.plan))]
    every = source.frame_from_scene.cameras(Cameras.cat([cameras, source.plan.cameras]))
    kinds = ["captured"] * len(names) + ["planned"] * len(planned)
    own = [str(name) for name in source.store.captured.read("name")[train]]
    write_transforms(folder, every, names + planned, kinds, [*own, *([None] * len(planned))])
    nothing = np.zeros((0, 3))
    write_colmap(folder / "sparse" / "0", every, names + planned, nothing, nothing.astype(np.uint8))
    width, height = source.plan.cameras.size[0].tolist()
    text = _READ_ME.format(
        count=len(planned), first=view_name(0), last=view_name(len(planned) - 1), width=width, height=height,
        store=store_path, run=source.run.name,
    )  # fmt: skip
    (folder / "README.txt").write_text(text, encoding="utf-8")
    if source.scene is not None:
        _write_hints(source, source.scene, cameras, photos, folder / "hints")
    return len(planned)


def _write_hints(
    source: PlanSource, scene: Reconstructor, cameras: Cameras, photos: list[torch.Tensor], folder: Path
) -> None:
    """Depth of each planned view by the reconstruction, and the nearest photos warped by it, the nearest first."""
    folder.mkdir(exist_ok=True)
    depths = [scene.render(cameras, i).depth.cpu().float() for i in range(len(cameras))]
    targets = source.plan.cameras
    with meter(f"hints {source.store.scene_id} {source.run.name}", len(targets)) as progress:
        for view in range(len(targets)):
            depth = scene.render(targets, view).depth.cpu().float()
            order = (cameras.centers - targets.centers[view]).norm(dim=-1).argsort()[:NEAREST].tolist()
            colours = [photos[i].permute(2, 0, 1).float() / 255 for i in order]
            image, seen = warp(colours, [depths[i] for i in order], cameras[order], targets[view], depth)
            name = Path(view_name(view))
            np.save(folder / f"{name.stem}_depth.npy", (depth * source.frame_from_scene.scale).numpy())
            rgba = torch.cat([image, seen[None].float()]).permute(1, 2, 0)
            write_png(folder / name, to_uint8(rgba))
            progress.advance()
