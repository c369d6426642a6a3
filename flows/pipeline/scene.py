"""The flow of one scene: its stages as Prefect tasks, each run only where the store does not hold its result yet.

Tasks get the job (paths and settings) and the step (the wanted content key); results stay in the store.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from prefect import flow, task
from prefect.cache_policies import NO_CACHE
from rich.markup import escape

from flows.jobs.job import Job
from flows.pipeline.keys import Step
from flows.pipeline.runner import execute_stage, opened, run_missing
from flows.progress import console
from schemas.stages import StageRecord

#: Trying again helps where the machine failed for a moment, not where the input or the mathematics is at fault.
RETRIES = 2


def _worth_retrying(_task: Any, _run: Any, state: Any) -> bool:
    error = state.result(raise_on_failure=False)
    return isinstance(error, OSError) and not isinstance(error, (FileNotFoundError, PermissionError))


@task(retries=RETRIES, retry_delay_seconds=[1, 5], retry_condition_fn=_worth_retrying, cache_policy=NO_CACHE,
      task_run_name="{step.stage} {job.scene_id}")  # fmt: skip
def run_stage(job: Job, step: Step) -> StageRecord:
    """Run one stage of a job and record it. Returns the record, not the data."""
    return execute_stage(job, step)


@flow(name="cat3d-scene", flow_run_name="{scene_id}", validate_parameters=False)
def scene_flow(scene_id: str, jobs: Sequence[Job]) -> list[StageRecord]:
    """All stages of all jobs of one scene that are not done yet, in order. Returns the records of what ran."""
    return run_jobs(jobs)


def run_jobs(jobs: Sequence[Job]) -> list[StageRecord]:
    """What `scene_flow` does, inside whichever flow calls it: the jobs of one scene, each missing stage a task."""

    def execute(job: Job, step: Step) -> StageRecord:
        console.print(f"[bold]{step.stage}[/bold] {job.scene_id} {job.run} ({escape(step.why)})")
        record: StageRecord = run_stage(job, step)
        return record

    with opened(jobs[0]):
        return [record for job in jobs for record in run_missing(job, execute=execute)]
