"""The flow of one scene: its stages as Prefect tasks, each run only where the store does not hold its result yet.

Tasks get the job (paths and settings) and the step (the wanted content key); results stay in the store.
"""

from __future__ import annotations

import dataclasses
import importlib
import platform
import resource
import time
from datetime import datetime
from typing import Any

import numpy as np
from prefect import flow, task
from prefect.cache_policies import NO_CACHE

from flows.pipeline.jobs import Job, Step, capture_digests, expected_steps, pending
from flows.pipeline.locks import writing
from flows.pipeline.versions import provenance
from flows.progress import console
from flows.readers.base import Capture
from schemas.errors import StoreError
from schemas.layout import ROLES
from schemas.scene_store import SceneStore
from schemas.stages import StageRecord, now
from schemas.tables import TIMINGS, append_rows

#: Trying again helps where the machine failed for a moment, not where the input or the mathematics is at fault.
RETRIES = 2


def _worth_retrying(_task: Any, _run: Any, state: Any) -> bool:
    error = state.result(raise_on_failure=False)
    return isinstance(error, OSError) and not isinstance(error, (FileNotFoundError, PermissionError))


@task(retries=RETRIES, retry_delay_seconds=[1, 5], retry_condition_fn=_worth_retrying, cache_policy=NO_CACHE,
      task_run_name="{stage} {job[scene_id]}")  # fmt: skip
def run_stage(stage: str, job: dict[str, Any], step: dict[str, Any]) -> dict[str, Any]:
    """Run one stage of a job and record it. Returns the record, not the data."""
    return execute_stage(Job.model_validate(job), Step(**step)).model_dump(mode="json")


@flow(name="cat3d-scene", flow_run_name="{scene_id}", validate_parameters=False)
def scene_flow(scene_id: str, jobs: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """All stages of all jobs of one scene that are not done yet, in order. Returns the records of what ran."""
    return run_jobs([Job.model_validate(job) for job in jobs])


def run_jobs(jobs: list[Job]) -> list[dict[str, Any]]:
    """What `scene_flow` does, inside whichever flow calls it: the jobs of one scene, each missing stage a task."""
    records = []
    capture = jobs[0].capture()
    digests = capture_digests(capture)
    with writing(jobs[0].store_path, jobs[0].scene_id):
        ensure_store(jobs[0], capture)
        for job in jobs:
            prepare_run(job, capture)
            for step in pending(job, expected_steps(job, capture, digests)):
                console.print(f"[bold]{step.stage}[/bold] {job.scene_id} {job.run} ({step.why})")
                records.append(run_stage(step.stage, job.model_dump(mode="json"), dataclasses.asdict(step)))
    return records


def execute_stage(job: Job, step: Step) -> StageRecord:
    """Do the work of a stage, then record it: data first, record last. Plain Python, no Prefect needed."""
    store = SceneStore.open(job.store_path, "r+")
    # Taken back before the data changes: a kill in between must not leave a record of what is no longer there.
    store.forget(step.stage, job.run)
    module = importlib.import_module(f"flows.stages.{step.stage}")
    started_at, started = now(), time.monotonic()
    outcome = module.execute(job, store, step.key)
    record = StageRecord(
        stage=step.stage,
        key=step.key,
        inputs=step.inputs,
        config=step.config,
        code_version=step.version,
        started_at=started_at,
        finished_at=now(),
        seconds=time.monotonic() - started,
        work=outcome.work,
        decisions=outcome.decisions,
    )
    store.complete(step.stage, record, job.run)
    write_timing(job, record)
    for sentence in outcome.decisions:
        console.print(f"  [dim]{sentence}[/dim]")
    return record


def write_timing(job: Job, record: StageRecord) -> None:
    """One row per execution in `timings/`; the file's name holds the time, so that earlier executions stay."""
    known = {name: int(value) for name, value in record.work.items() if name in TIMINGS.names}
    row = {
        "scene_id": job.scene_id, "dataset": job.dataset, "run": job.run, "method": job.label,
        "split": job.config.split, "seed": job.config.seed, "key": record.key, "code_version": record.code_version,
        "stage": record.stage, "started_at": datetime.fromisoformat(record.started_at), "seconds": record.seconds,
        "skipped": False, "peak_memory_bytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024,
        "workers": 1, "device": "cpu", "host": platform.node(), **known,
    }  # fmt: skip
    stamp = record.started_at.replace(":", "").replace("+", "_")
    append_rows(job.out / "timings", TIMINGS, [row], f"{job.scene_id}.{job.run}.{record.stage}.{stamp}")


def ensure_store(job: Job, capture: Capture) -> None:
    """Make the scene's store on the first run; later runs find it."""
    if job.store_path.exists():
        store = SceneStore.open(job.store_path, "r+")
        if store.dataset != job.dataset:
            raise StoreError(
                f"{job.store_path} holds a scene of {store.dataset}, this one is of {job.dataset}; "
                "choose another --out."
            )
        store.sweep()
        return
    job.out.mkdir(parents=True, exist_ok=True)
    SceneStore.create(job.store_path, job.scene_id, capture.dataset, provenance() | {"source": job.source})


def prepare_run(job: Job, capture: Capture) -> None:
    """Make the run's group and write the role of each captured view."""
    store = SceneStore.open(job.store_path, "r+")
    run = store.run(job.run, create=True)
    split = job.split(capture)
    roles = np.zeros(len(capture), np.uint8)
    for role in ("train", "test"):
        roles[split[role]] = ROLES[role]
    if "role" not in run or not np.array_equal(run.read("role"), roles):
        run.write("role", roles)
    run.set_attrs(job=job.model_copy(update={"store": None, "results": None}).model_dump(mode="json"))
