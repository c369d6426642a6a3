"""What a stage is: one declaration, from which its place, its content key and its work follow.

To add a stage: a module in `flows/stages/` with a `STAGE`, its arrays in `schemas/layout.py`, and the `STAGE` in the
list `STAGES` of `flows/stages/__init__.py`. Nothing else knows the stages.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

from flows.jobs.job import Job, Outcome
from schemas.config import RunConfig
from schemas.scene_store import SceneStore


def _always(_job: Job) -> bool:
    return True


def generates(job: Job) -> bool:
    """For `Stage.wanted`: where views are generated."""
    return job.generates


def _nothing(_config: RunConfig) -> dict[str, Any]:
    return {}


def _no_inputs(_job: Job, _keys: Mapping[str, str]) -> dict[str, Any]:
    return {}


@dataclass(frozen=True)
class Stage:
    """A step from stored results to further ones.

    name: also that of its record, and of its arrays in the layout. reads: the stages whose results it reads; their keys
    are part of its own. per: done once for a `scene`, or for each `run`. version: raised when the same inputs give
    another result.
    execute(job, store, key): reads what earlier stages stored, calls the core and writes the stage's own group of the
    store; `key` is its content key.
    settings(config): the settings that can change the result, as plain JSON values.
    inputs(job, keys): what else the result depends on, as plain JSON values. keys: the content keys of earlier stages;
    an entry "STAGE key" replaces the key of a stage that is read by what of it matters.
    wanted(job): whether the job has the stage at all.
    passing: its result serves the next stage alone, and may be another run's by then: not redone while that stage is
    done.
    """

    name: str
    execute: Callable[[Job, SceneStore, str], Outcome]
    version: int
    reads: tuple[str, ...] = ()
    per: Literal["scene", "run"] = "run"
    settings: Callable[[RunConfig], dict[str, Any]] = _nothing
    inputs: Callable[[Job, Mapping[str, str]], dict[str, Any]] = _no_inputs
    wanted: Callable[[Job], bool] = _always
    passing: bool = False


def settings_of(name: str, *others: str, without: tuple[str, ...] = ()) -> Callable[[RunConfig], dict[str, Any]]:
    """Settings of a stage: the section `name` of the configuration but for `without`, and `others` beside it."""

    def settings(config: RunConfig) -> dict[str, Any]:
        document = config.model_dump(mode="json")
        own = {field: value for field, value in document[name].items() if field not in without}
        return own | {field: document[field] for field in others}

    return settings
