"""What a stage is: one declaration, from which its place, its content key and its work follow.

To add a stage: a module in `flows/stages/` with a `STAGE`, its arrays in `schemas/layout.py`, and the `STAGE` in the
list `STAGES` of `flows/stages/__init__.py`. Nothing else knows the stages.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from flows.jobs.job import Job, Outcome
from flows.jobs.needs import Needs
from schemas.config import RunConfig
from schemas.layout import SCENE_STAGES
from schemas.scene_store import SceneStore


def _always(_job: Job) -> bool:
    return True


def generates(job: Job) -> bool:
    """For `Stage.wanted`: where views are generated."""
    return job.generates


def _nothing(_config: RunConfig) -> dict[str, Any]:
    return {}


def _never(_job: Job) -> bool:
    return False


def _no_inputs(_job: Job, _keys: Mapping[str, str]) -> dict[str, Any]:
    return {}


@dataclass(frozen=True)
class Stage:
    """A step from stored results to further ones.

    name: also that of its record, and of its arrays in the layout. reads: the stages whose results it reads; their keys
    are part of its own. version: raised when the same inputs give another result.
    execute(job, store, key): reads what earlier stages stored, calls the core and writes the stage's own group of the
    store; `key` is its content key.
    settings(config): the settings that can change the result, as plain JSON values.
    inputs(job, keys): what else the result depends on, as plain JSON values. keys: the content keys of earlier stages;
    an entry "STAGE key" replaces the key of a stage that is read by what of it matters.
    wanted(job): whether the job has the stage at all.
    seedless(job): whether its result is the same for every seed, so that runs of all seeds share one.
    passing: its result serves the next stage alone, and may be another run's by then: not redone while that stage is
    done.
    needs: what it asks of a worker. spreads: `execute` itself hands its items out to workers (`fan_out`), so that it is
    done by the command; every other stage is done as a whole by one worker.
    """

    name: str
    execute: Callable[[Job, SceneStore, str], Outcome]
    version: int
    reads: tuple[str, ...] = ()
    settings: Callable[[RunConfig], dict[str, Any]] = _nothing
    inputs: Callable[[Job, Mapping[str, str]], dict[str, Any]] = _no_inputs
    wanted: Callable[[Job], bool] = _always
    seedless: Callable[[Job], bool] = _never
    passing: bool = False
    needs: Needs = Needs()
    spreads: bool = False

    @property
    def per(self) -> Literal["scene", "run"]:
        """Done once for a scene, as its arrays in the layout are outside of runs, or once for each run."""
        return "scene" if self.name in SCENE_STAGES else "run"


def settings_of(
    name: str, *others: str, without: Sequence[str] = (), unless: Mapping[str, Any] | None = None
) -> Callable[[RunConfig], dict[str, Any]]:
    """Settings of a stage: the section `name` of the configuration but for the fields `without`, and `others` beside.

    unless: fields that are left out where they have this value; results from before there was the field stay valid.
    """
    left_out = dict(unless or {})

    def settings(config: RunConfig) -> dict[str, Any]:
        document = config.model_dump(mode="json")
        own = {field: value for field, value in document[name].items() if field not in without}
        own = {field: value for field, value in own.items() if field not in left_out or left_out[field] != value}
        return own | {field: document[field] for field in others}

    return settings
