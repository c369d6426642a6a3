"""What there is to see of a store: views with their pictures, points, the reconstruction, all as far as it has come."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cat3d_core.cameras import Cameras
from cat3d_core.reconstruction import Reconstructor
from cat3d_core.weights_file import read_weights
from flows.errors import InputError
from flows.jobs.access import read_cameras
from flows.jobs.device import device
from flows.jobs.job import Job
from flows.reconstruction.open import open_reconstructor, reconstructor_class
from flows.reconstruction.stored import checkpoint_path, read_reconstruction
from schemas.layout import ROLES
from schemas.scene_store import Run, SceneStore


@dataclass(frozen=True)
class ShownView:
    """A camera (a batch of one, scene frame) and its picture (h, w, 3) uint8, where there is one.

    kind: "train" and "test" of the captured views, "generated", or "planned" where no picture is there yet. index: in
    the captured views or the plan. share: place along the plan, 0 to 1. anchor: of the plan.
    """

    kind: str
    name: str
    index: int
    camera: Cameras
    image: np.ndarray | None
    share: float = 0.0
    anchor: bool = False


def captured_views(store: SceneStore, run: Run, pictures: bool = True) -> Iterator[ShownView]:
    """The captured views whose cameras are known and that the run uses; pictures: with their photos."""
    if "world_from_camera" not in store.captured:
        return
    cameras, names = read_cameras(store.captured), store.captured.read("name")
    registered, roles = store.captured.read("registered"), run.read("role")
    for kind in ("train", "test"):
        for view in np.flatnonzero(registered & (roles == ROLES[kind])).tolist():
            image = store.captured.read_image("image", view) if pictures else None
            yield ShownView(kind, str(names[view]), view, cameras[view], image)


def planned_views(run: Run, pictures: bool = True) -> Iterator[ShownView]:
    """The plan's views in order; pictures: those that are generated with their pictures, without the padding."""
    if "plan" not in run or "world_from_camera" not in run.plan:
        return
    cameras, windows, anchors = read_cameras(run.plan), run.plan.read("window"), run.plan.read("anchor")
    done = pictured(run)
    for view in range(len(cameras)):
        x0, y0, width, height = windows[view].tolist()
        image, made = None, len(done) > 0 and bool(done[view])
        if made and pictures:
            image = run.generated.read("image", [view])[0, y0 : y0 + height, x0 : x0 + width]
        camera = cameras[view].crop(x0, y0, width, height)
        share = view / max(1, len(cameras) - 1)
        kind = "generated" if made else "planned"
        yield ShownView(kind, f"{kind} {view}", view, camera, image, share, bool(anchors[view]))


def pictured(run: Run) -> np.ndarray:
    """(planned views,) bool: which of them have their picture; empty where there are none."""
    if "generated" not in run or "done_image" not in run.generated:
        return np.zeros(0, bool)
    return np.asarray(run.generated.read("done_image").any(-1))


def scene_points(store: SceneStore) -> np.ndarray:
    """(P, 3) float32 sparse points of the scene frame."""
    if "points" not in store.captured:
        return np.zeros((0, 3), np.float32)
    return store.captured.read("points").astype(np.float32)


@dataclass(frozen=True)
class Shape:
    """How far a run has come, to see whether anything is new: keys of the finished stages, number of generated views,
    and the time of the checkpoint of a training under way."""

    stages: tuple[tuple[str, str], ...]
    generated: int
    checkpoint: float


def shape_of(store: SceneStore, run: Run) -> Shape:
    stages = []
    for stage in ("poses", "plan", "reconstruct"):
        record = store.record(stage, None if stage == "poses" else run.name)
        stages.append((stage, record.key if record else ""))
    path = _checkpoint(store, run)
    return Shape(tuple(stages), int(pictured(run).sum()), path.stat().st_mtime if path else 0.0)


def _checkpoint(store: SceneStore, run: Run) -> Path | None:
    """The checkpoint of the run's training, where one is under way."""
    document = run.attrs.get("job")
    if document is None:
        return None
    path = checkpoint_path(store.folder.parent, store.scene_id, run.name)
    return path if path.exists() else None


def reconstruction(store: SceneStore, run: Run) -> Reconstructor | None:
    """The run's reconstruction; of one that is being trained as its last checkpoint left it, where its method can show
    that; None where there is nothing yet. Raises InputError where it cannot be read."""
    if store.record("reconstruct", run.name) is not None:
        return read_reconstruction(store, run)
    path = _checkpoint(store, run)
    if path is None:
        return None
    job = Job.model_validate(run.attrs["job"])
    kind = reconstructor_class(job.config.reconstruct.method)
    if not hasattr(kind, "from_state"):
        return None
    try:
        _, state = read_weights(path)
        return kind.from_state(open_reconstructor(job).settings, state, device())  # type: ignore[no-any-return]
    except (OSError, ValueError, KeyError) as error:
        raise InputError(f"The checkpoint {path} cannot be shown: {error}") from None
