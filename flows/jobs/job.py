"""One run of one scene, and what a stage of it did."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

from pydantic import BaseModel, ConfigDict, PrivateAttr

from flows.errors import InputError
from flows.jobs.scene import Scene
from flows.jobs.usage import Usage
from flows.readers.base import Capture
from schemas.config import RunConfig
from schemas.decisions import Decision


class Job(BaseModel):
    """One run of one scene: where it comes from, which views train, how, and where results go. JSON in, JSON out.

    working_size: why the photos are made smaller, where that was chosen here (`flows/pipeline/working_size.py`).
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    source: str
    reader: str = "auto"
    image_folder: str | None = None
    out: Path
    scene_id: str
    dataset: str
    config: RunConfig
    store: Path | None = None
    results: Path | None = None
    working_size: str = ""

    _scene: Scene = PrivateAttr()

    def model_post_init(self, _context: Any) -> None:
        self._scene = self._place()

    def _place(self) -> Scene:
        return Scene(self.source, self.reader, self.image_folder, self.config.ingest.frames)

    @property
    def store_path(self) -> Path:
        """Where the scene's store is; `store` overrides it while a scene is reprocessed beside its old results."""
        return self.store or self.out / f"{self.scene_id}.zarr"

    @property
    def label(self) -> str:
        """The method's name, or that of the ablation."""
        method = self.config.reconstruct.method
        generating = "cat3d" if method == "zipnerf" else f"cat3d-{method}"
        return self.config.label or (generating if self.generates else method)

    @property
    def generates(self) -> bool:
        """Whether views are generated."""
        return self.config.generate != "never"

    @property
    def hinted(self) -> bool:
        """Whether what photos show is carried into generated views: with the shipped model, or where asked for."""
        hints, sample = self.config.hints, self.config.sample
        shipped = sample.checkpoint is None and sample.generator is None
        return self.generates and (hints.use == "always" or (hints.use == "auto" and shipped))

    @property
    def run(self) -> str:
        """Name of the run inside the store, e.g. "v3-zipnerf"; seeds other than 0 are named too."""
        seed = f"-s{self.config.seed}" if self.config.seed else ""
        return f"v{self.config.split}-{self.label}{seed}"

    @property
    def results_path(self) -> Path:
        """Folder of metrics and pictures; `results` overrides it as `store` does the store."""
        return self.results or self.out

    @property
    def pictures(self) -> Path:
        """Folder of the run's pictures, videos and exports."""
        return self.results_path / self.scene_id / self.run

    @property
    def scene(self) -> Scene:
        """The scene where it lies; copies of a job share what was read of it, unless they name another place."""
        if self._scene != (place := self._place()):
            self._scene = place
        return self._scene

    def sharing(self, scene: Scene) -> Job:
        """The job, which takes what was read of its scene already."""
        copy = self.model_copy()
        copy._scene = scene
        return copy

    def capture(self) -> Capture:
        """The scene as its reader found it."""
        return self.scene.capture

    @property
    def split(self) -> dict[str, list[int]]:
        """Training and test indices of this run. Raises SplitError when the scene has no such split."""
        splits = self.capture().splits
        if self.config.split not in splits:
            known = ", ".join(splits) or "none"
            raise SplitError(
                f"Scene {self.scene_id} has no split for {self.config.split} views (its splits: {known}); "
                "choose one of those with --views."
            )
        return splits[self.config.split]

    def view_names(self, role: str) -> list[str]:
        """Names of the views that train ("train") or are held out ("test")."""
        return [self.capture().names[view] for view in self.split[role]]


class SplitError(InputError):
    """The scene has no split for the number of training views that is asked for."""


class Outcome(NamedTuple):
    """What a stage did: `work` counts (views, rays, ...); `decisions` say what was chosen, skipped or is wrong; `usage`
    is that of other processes that had a share of the work; `waited` are the seconds in which no worker had time for
    it, which are not the stage's."""

    work: dict[str, float] = {}
    decisions: list[Decision] = []
    usage: Usage = Usage()
    waited: float = 0.0
