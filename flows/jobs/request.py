"""What a command asks for: a scene, the runs of it, and their configuration."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from cat3d_core.diffusion.solvers import check_solver
from flows.jobs.job import Job
from flows.jobs.scene import Scene
from flows.names import source_text
from schemas.config import RunConfig, load_config, parse_config
from schemas.errors import ConfigError
from schemas.settings import merged, set_at, settings_document, value_at

#: Where each command-line option lives in the configuration.
OPTION_FIELDS = {
    "downscale": ("ingest", "downscale"),
    "method": ("method",),
    "preset": ("reconstruct", "preset"),
    "seed": ("seed",),
    "model": ("sample", "checkpoint"),
    "trajectory": ("plan", "trajectory"),
    "count": ("plan", "views"),
}


@dataclass(frozen=True)
class Request:
    """Runs of one scene, one for each of `views` (splits), with one configuration; out: folder of the results."""

    source: str
    out: Path
    views: tuple[str, ...] = ("all",)
    config: RunConfig = field(default_factory=RunConfig)
    reader: str = "auto"
    image_folder: str | None = None

    def scene(self) -> Scene:
        """Where the scene lies, to be found from anywhere."""
        return Scene(source_text(absolute(self.source)), self.reader, self.image_folder, self.config.ingest.frames)

    def jobs(self, scene: Scene | None = None) -> list[Job]:
        """A job for each split, with `generate: auto` decided. scene: where that was read already.

        Raises InputError for bad input, SplitError for an unknown split, ConfigError for an unknown solver.
        """
        if self.config.sample.solver is not None:
            try:  # solvers are registered in the core, which the schemas do not see
                check_solver(self.config.sample.solver)
            except ValueError as error:
                raise ConfigError(f"sample.solver: {error}") from None
        scene = scene or self.scene()
        jobs = []
        for split in self.views:
            job = Job(
                source=scene.source,
                reader=scene.reader,
                image_folder=scene.image_folder,
                out=self.out,
                scene_id=scene.capture.scene_id,
                dataset=scene.capture.dataset,
                config=self.config.model_copy(update={"split": split}),
            ).sharing(scene)
            few = len(job.split["train"]) == 1
            if job.config.generate == "auto":
                config = job.config.model_copy(update={"generate": "always" if few else "never"})
                job = job.model_copy(update={"config": config})
            jobs.append(job)
        return jobs


def absolute(source: str) -> str:
    """A folder or file as it is found from anywhere, so that a store can be looked at from another folder; what is no
    path that exists, such as procedural:llff/1, stays."""
    return str(Path(source).absolute()) if Path(source).exists() else source


def make_request(
    source: str | Path, out: Path, views: str, given: Mapping[str, Any], reader: str = "auto",
    image_folder: str | None = None, config_file: Path | None = None, settings: Sequence[str] = (),
) -> Request:  # fmt: skip
    """The request of a command line. views: splits, separated by commas; the rest as in `make_config`."""
    config = make_config(given, config_file, settings)
    splits = tuple(view.strip() for view in views.split(","))
    return Request(str(source), out.resolve(), splits, config, reader, image_folder)


def make_config(given: Mapping[str, Any], config_file: Path | None, settings: Sequence[str]) -> RunConfig:
    """The run's configuration: file, then options that differ from their defaults, then --set."""
    document = load_config(config_file).model_dump(mode="json") if config_file else {}
    defaults = RunConfig().model_dump(mode="json") | {"method": "auto"}
    options: dict[str, Any] = {}
    for name, value in given.items():
        path = OPTION_FIELDS[name]
        if config_file is None or value != value_at(defaults, path):
            set_at(options, path, value)
    config: RunConfig = parse_config(merged(document, options, settings_document(settings)), "the settings")
    return config
