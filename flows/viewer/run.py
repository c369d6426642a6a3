"""A run that someone looks at, as far as it has come."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from cat3d_core.cameras import Cameras
from cat3d_core.normalization import Similarity
from cat3d_core.reconstruction import Reconstructor
from cat3d_core.splats import Gaussians
from flows.errors import InputError
from flows.exports.preview import kept_preview
from flows.jobs.access import read_similarity
from flows.reporting import content
from flows.reporting.content import Shape, ShownView
from flows.viewer.folder import ResultTable
from schemas.errors import StoreError
from schemas.scene_store import Run, SceneStore


@dataclass
class OpenRun:
    """A run that someone looks at. `frame_from_scene`: to the data set's own world."""

    name: str
    store: SceneStore
    run: Run
    views: list[ShownView] = field(default_factory=list)
    points: np.ndarray = field(default_factory=lambda: np.zeros((0, 3), np.float32))
    scene: Reconstructor | None = None
    splats: Gaussians | None = None
    shape: Shape | None = None
    frame_from_scene: Similarity | None = None
    problem: str = ""

    def read(self) -> None:
        """Read what there is, as far as the run has come."""
        shape = content.shape_of(self.store, self.run)
        old, self.shape = self.shape, shape
        self.views = [*content.captured_views(self.store, self.run), *content.planned_views(self.run)]
        self.points = content.scene_points(self.store)
        if self.frame_from_scene is None and "similarity" in self.store.captured.attrs:
            self.frame_from_scene = read_similarity(self.store).inverse()
        trained = (shape.stages[-1], shape.checkpoint)
        if old is None or trained != (old.stages[-1], old.checkpoint):
            self.problem = ""
            try:
                self.scene = content.reconstruction(self.store, self.run)
            except (InputError, StoreError) as error:
                self.problem = str(error)
            self.splats = kept_preview(self.store, self.run)

    @property
    def cameras(self) -> Cameras | None:
        """Those of all its views."""
        return Cameras.cat([view.camera for view in self.views]) if self.views else None

    def state(self) -> str:
        """How far it has come, in a sentence or two."""
        kinds = [view.kind for view in self.views]
        parts = [f"{kinds.count('train')} captured views, {kinds.count('test')} held out"]
        if "planned" in kinds or "generated" in kinds:
            generated = kinds.count("generated")
            parts.append(f"{generated} of {kinds.count('planned') + generated} generated")
        done = self.shape is not None and bool(self.shape.stages[-1][1])
        parts.append(
            "reconstructed" if done else "being trained" if self.scene is not None else "not reconstructed yet"
        )
        if self.splats is not None:
            parts.append(f"{len(self.splats)} splats")
        elif self.scene is not None:
            parts.append("splats are being made")
        return f"{'; '.join(parts)}. {self.problem}".strip()


class Runs(Protocol):
    """The runs that can be looked at, by name, and the table of their results."""

    names: list[str]
    table: ResultTable | None

    def opened(self, name: str) -> OpenRun:
        """A run by its name. Raises InputError or StoreError where it cannot be read."""
        ...
