"""A whole stage as an item of work, for any worker: what the command hands out, and what the worker does with it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from flows.generation.open import forget_generator
from flows.jobs.device import device
from flows.jobs.job import Job
from flows.locks import only_worker
from flows.pipeline.keys import Step, stage
from flows.pipeline.runner import execute_stage
from flows.workers.pulse import Pulse, read_pulse
from flows.workers.work import Sign, Work
from schemas.layout import SCENE_STAGES
from schemas.scene_store import SceneStore


class StageWork(Work):
    """One stage of one job, done as a whole. It is finished when its record says so."""

    def __init__(self, job: Job, step: Step) -> None:
        self.step, self.path = step, work_path(job, step.stage)
        needs, arguments = stage(step.stage).needs, {"step": asdict(step)}
        super().__init__(job, step.stage, step.key, needs, prepare, do_stage, [[0]], arguments)

    def size(self, items: Iterable[int]) -> int:
        return len(list(items))

    def finished(self, item: int) -> bool:
        return is_recorded(SceneStore.open(self.job.store_path), self.job, self.step)

    def sign(self, item: int) -> Sign | None:
        return read_pulse(self.path.with_suffix(".pulse"))


def work_path(job: Job, name: str) -> Path:
    """Where a stage under way has its lock and its signs of life, without the ending."""
    owner = job.scene_id if name in SCENE_STAGES else f"{job.scene_id}-{job.run}"
    return job.out / ".work" / f"{owner}-{name}.x"


def is_recorded(store: SceneStore, job: Job, step: Step) -> bool:
    """Whether the stage is complete with exactly this key."""
    record = store.record(step.stage, job.run)
    return record is not None and record.key == step.key


def prepare(_job: Job) -> None:
    """A stage loads for itself what it needs. On an accelerator, a generator that this worker has keeps its memory from
    it."""
    if device() != "cpu":
        forget_generator()


def do_stage(job: Job, store: SceneStore, _key: str, _items: Sequence[int], step: dict[str, Any]) -> None:
    """A worker's share: do the stage and record it, unless another worker has done so meanwhile."""
    asked, path = Step(**step), work_path(job, step["stage"])
    what = f"{asked.stage} of {job.scene_id} {job.run}"
    patience = job.config.execution.timeout_s
    with only_worker(path.with_suffix(".lock"), what, patience), Pulse(path.with_suffix(".pulse")):
        if not is_recorded(store, job, asked):
            execute_stage(job, asked)
