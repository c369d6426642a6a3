"""Which stages of a job are not done yet.

A stage's content key covers the keys of the stages it reads, its own inputs and configuration, and its code version.
Keys follow from the inputs alone, so what is stale is known before anything runs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from flows.jobs.job import Job
from flows.jobs.stage import Stage
from flows.stages import STAGES
from schemas.content_key import content_key
from schemas.errors import MissingError
from schemas.scene_store import SceneStore


@dataclass(frozen=True)
class Step:
    """One stage of one job with everything its content key is made of. older: the key of an equal result that was made
    when the seed was part of every key."""

    stage: str
    key: str
    inputs: dict[str, Any]
    config: dict[str, Any]
    version: str
    why: str = field(default="", compare=False)
    older: str = field(default="", compare=False)


def stage(name: str) -> Stage:
    """The stage of this name. Raises ValueError for a name that is no stage."""
    for one in STAGES:
        if one.name == name:
            return one
    raise ValueError(f"{name!r} is not a stage; the stages are {', '.join(s.name for s in STAGES)}.")


def stages_of(job: Job) -> list[Stage]:
    """The stages of the job, in order."""
    return [one for one in STAGES if one.wanted(job)]


def upstream(name: str) -> tuple[str, ...]:
    """`name` and every stage whose results it reads, directly or not, in the order they run."""
    wanted = {name}
    for one in reversed(STAGES):
        if one.name in wanted:
            wanted |= set(one.reads)
    return tuple(one.name for one in STAGES if one.name in wanted)


def downstream(name: str) -> tuple[str, ...]:
    """`name` and every stage that reads its results, directly or not, in the order they run."""
    affected = {stage(name).name}
    for one in STAGES:
        if affected.intersection(one.reads):
            affected.add(one.name)
    return tuple(one.name for one in STAGES if one.name in affected)


def expected_steps(job: Job) -> dict[str, Step]:
    """Every stage of the job with the key it must have, by stage name."""
    steps: dict[str, Step] = {}
    for one in stages_of(job):
        keys = {name: step.key for name, step in steps.items()}
        older = {name: step.older for name, step in steps.items()}
        inputs, config, version = _inputs(one, job, keys), one.settings(job.config), str(one.version)
        older_key = ""
        if older != keys or one.seedless(job):
            before = _inputs(one, job, older) if older != keys else inputs
            older_key = content_key(stage=one.name, inputs=before, config=config, version=version)
        if one.seedless(job):
            config = config | {"seed": 0}
        key = content_key(stage=one.name, inputs=inputs, config=config, version=version)
        steps[one.name] = Step(one.name, key, inputs, config, version, older=older_key or key)
    return steps


def _inputs(one: Stage, job: Job, keys: dict[str, str]) -> dict[str, Any]:
    return {f"{name} key": keys[name] for name in one.reads if name in keys} | one.inputs(job, keys)


def pending(job: Job, steps: dict[str, Step] | None = None) -> list[Step]:
    """The steps whose record is missing or has another key, each with the reason. steps: `expected_steps(job)`."""
    steps = steps or expected_steps(job)
    try:
        store = SceneStore.open(job.store_path)
    except MissingError:
        return [replace(step, why="not done yet") for step in steps.values()]
    reasons = {name: stale_reason(store, job.run, step) for name, step in steps.items()}
    own = [stage(name) for name in steps]
    for one in own:
        if one.passing and store.record(one.name, job.run) is not None:
            readers = [reader.name for reader in own if one.name in reader.reads]
            if not any(reasons[name] for name in readers):
                reasons[one.name] = ""
    return [replace(step, why=reasons[name]) for name, step in steps.items() if reasons[name]]


def stale_reason(store: SceneStore, run: str, step: Step) -> str:
    """Why the step must run (a phrase), or "" when its stored result is the one that is wanted."""
    if stage(step.stage).per == "run" and run not in store.runs():
        return "not done yet"
    record = store.record(step.stage, run)
    if record is None:
        return "not done yet"
    if record.key in (step.key, step.older):
        return ""
    changes = []
    if record.code_version != step.version:
        changes.append(f"code version {record.code_version} is now {step.version}")
    changes += [f"{n} changed" for n in _changed(record.inputs, step.inputs)]
    changes += [f"setting {n} changed" for n in _changed(record.config, step.config)]
    return "; ".join(changes) or "its key changed"


def _changed(old: dict[str, Any], new: dict[str, Any]) -> list[str]:
    names: Sequence[str] = sorted(set(old) | set(new))
    return [n.removesuffix(" key") for n in names if content_key(v=old.get(n)) != content_key(v=new.get(n))]
