"""A stage as a Prefect task, and the flow of one scene.

Tasks get the job (paths and settings) and the step (the wanted content key); results stay in the store.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from prefect import flow, task
from prefect.cache_policies import NO_CACHE
from rich.markup import escape

from flows.jobs.job import Job
from flows.object_storage import copy_out
from flows.pipeline.keys import Step, stage
from flows.pipeline.prefect_records import Advance, claim, is_deployed, publish
from flows.pipeline.runner import execute_stage
from flows.pipeline.side_by_side import Result, do_jobs
from flows.pipeline.stage_work import StageWork
from flows.progress import console
from flows.workers.fan_out import fan_out, pool_is_open
from schemas.layout import SCENE_STAGES
from schemas.scene_store import SceneStore
from schemas.stages import StageRecord

#: Trying again helps where the machine failed for a moment, not where the input or the mathematics is at fault.
RETRIES = 2


def _worth_retrying(_task: Any, _run: Any, state: Any) -> bool:
    error = state.result(raise_on_failure=False)
    return isinstance(error, OSError) and not isinstance(error, (FileNotFoundError, PermissionError))


@task(retries=RETRIES, retry_delay_seconds=[1, 5], retry_condition_fn=_worth_retrying, cache_policy=NO_CACHE,
      task_run_name="{step.stage} {job.scene_id} {job.run}")  # fmt: skip
def run_stage(job: Job, step: Step) -> StageRecord:
    """Do one stage of a job: here, or where the command's workers are, as a whole on one of them or in batches on all.
    Returns the record, not the data."""
    if not pool_is_open() or stage(step.stage).spreads:
        return execute_stage(job, step)
    totals = fan_out([StageWork(job, step)], job.config.execution, f"{step.stage} {job.scene_id} {job.run}")
    record = SceneStore.open(job.store_path).record(step.stage, job.run)
    assert record is not None  # else the fan-out had raised
    for decision in (*totals.decisions, *record.decisions):
        console.print(f"  {decision.text}", style="dim", markup=False)
    return record


def perform(job: Job, step: Step) -> StageRecord:
    """`run_stage` as a task that Prefect shows by scene, run and stage."""
    console.print(f"[bold]{step.stage}[/bold] {job.scene_id} {job.run} ({escape(step.why)})")
    tags = [step.stage, job.scene_id, *([] if step.stage in SCENE_STAGES else [job.run])]
    record: StageRecord = run_stage.with_options(tags=tags)(job, step)
    return record


@flow(name="cat3d-scene", flow_run_name="{scene_id}", validate_parameters=False)
def scene_flow(scene_id: str, jobs: Sequence[Job]) -> list[StageRecord]:
    """All stages of all jobs of one scene that are not done yet. Returns the records of what ran; raises the first
    error, when what does not need that stage is done."""
    records = [record for result in run_jobs(jobs) for record in result.records_or_raise()]
    return list({id(record): record for record in records}.values())  # one that two runs waited for is in both


def run_jobs(jobs: Sequence[Job], finished: Callable[[Result], None] | None = None, **options: Any) -> list[Result]:
    """`do_jobs` with each missing stage a task of the flow that calls this; a deployment's shows how far it is and what
    came of it. Results on object storage are copied there as runs end."""
    claim()

    def over(result: Result) -> None:
        if finished is not None:
            finished(result)
        copy_out(result.job.out)

    if not jobs or not is_deployed():
        return do_jobs(jobs, perform, over, **options)
    results = do_jobs(jobs, perform, over, advanced=Advance(jobs[0].out), **options)
    publish(jobs[0].out)
    return results
