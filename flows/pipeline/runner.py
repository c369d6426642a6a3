"""Doing what is missing of a job: the store is made ready, each missing stage is done and recorded. Plain Python."""

from __future__ import annotations

import contextlib
import platform
import time
from collections.abc import Callable, Iterator
from datetime import datetime
from pathlib import Path

import numpy as np

from flows.jobs.job import Job
from flows.jobs.usage import Usage, measured
from flows.locks import writing
from flows.pipeline.keys import Step, pending, stage, upstream
from flows.pipeline.versions import provenance
from flows.progress import console
from schemas.documents import sync_tree
from schemas.errors import StoreError
from schemas.layout import ROLES
from schemas.scene_store import Run, SceneStore
from schemas.stages import StageRecord, now
from schemas.tables import TIMINGS, append_rows

#: A file server's clock may be behind ours by so much (seconds).
CLOCKS_DIFFER_S = 60.0


@contextlib.contextmanager
def opened(job: Job) -> Iterator[None]:
    """Be the only writer of the store of the job's scene, which is made where there is none."""
    with writing(job.store_path, job.scene_id):
        ensure_store(job)
        yield


def execute_stage(job: Job, step: Step) -> StageRecord:
    """Do the work of a stage, then record it: data first, on the disk and not only on its way there, record last."""
    store = SceneStore.open(job.store_path, "r+")
    # Taken back before the data changes: a kill in between must not leave a record of what is no longer there.
    store.forget(step.stage, job.run)
    started_at, started, clock_s = now(), time.monotonic(), time.time()
    with measured() as usage:
        outcome = stage(step.stage).execute(job, store, step.key)
    for written in (store.folder, job.pictures):
        sync_tree(written, clock_s - CLOCKS_DIFFER_S)
    record = StageRecord(
        stage=step.stage,
        key=step.key,
        inputs=step.inputs,
        config=step.config,
        code_version=step.version,
        started_at=started_at,
        finished_at=now(),
        seconds=time.monotonic() - started - outcome.waited,
        work=outcome.work,
        decisions=outcome.decisions,
    )
    store.complete(step.stage, record, job.run)
    write_timing(job, record, usage.with_(outcome.usage))
    for decision in outcome.decisions:
        console.print(f"  {decision.text}", style="dim", markup=False)
    return record


def run_missing(
    job: Job, until: str | None = None, execute: Callable[[Job, Step], StageRecord] = execute_stage
) -> list[StageRecord]:
    """Do the stages of the job that are not done yet, in order; the store must be `opened`. Returns their records.

    until: only this stage and those it reads from, directly or not. execute: does and records one.
    """
    prepare_run(job)
    steps = pending(job)
    if until is not None:
        steps = [step for step in steps if step.stage in upstream(until)]
    return [execute(job, step) for step in steps]


def write_timing(job: Job, record: StageRecord, usage: Usage) -> None:
    """One row per execution in `timings/`; the file's name holds the time, so that earlier executions stay."""
    known = {name: int(value) for name, value in record.work.items() if name in TIMINGS.names}
    row = {
        "scene_id": job.scene_id, "dataset": job.dataset, "run": job.run, "method": job.label,
        "split": job.config.split, "seed": job.config.seed, "key": record.key, "code_version": record.code_version,
        "stage": record.stage, "started_at": datetime.fromisoformat(record.started_at), "seconds": record.seconds,
        "skipped": False, "peak_memory_bytes": usage.peak_memory_bytes, "workers": 1, "device": usage.device,
        "host": platform.node(), **known,
    }  # fmt: skip
    stamp = record.started_at.replace(":", "").replace("+", "_")
    append_rows(job.out / "timings", TIMINGS, [row], f"{job.scene_id}.{job.run}.{record.stage}.{stamp}")


def ensure_store(job: Job) -> None:
    """Make the scene's store on the first run; later runs find it."""
    if job.store_path.exists():
        store = SceneStore.open(job.store_path, "r+")
        if store.dataset != job.dataset:
            raise StoreError(
                f"{job.store_path} holds a scene of {store.dataset}, this one is of {job.dataset}; "
                "choose another --out."
            )
        check_source(store, job)
        store.sweep()
        return
    job.out.mkdir(parents=True, exist_ok=True)
    SceneStore.create(job.store_path, job.scene_id, job.dataset, provenance() | {"source": job.source})


def check_source(store: SceneStore, job: Job) -> None:
    """Refuse to write another scene's results over a stored one that has the same name.

    A scene that was moved, or whose photos were added to or replaced in part, is the same one: it lies where it lay, or
    some photo is the same. Raises StoreError.
    """
    before = store.attrs["provenance"].get("source")
    record = store.record("ingest")
    if before is None or record is None or _place(before) == _place(job.source):
        return
    known = set(record.inputs.get("images", {}).values())
    if known.isdisjoint(job.scene.digests["images"].values()):
        raise StoreError(
            f"{job.store_path} holds the scene of {before}, and {job.source} is another one of the same name: choose "
            "another --out, or rename the folder."
        )


def _place(source: str) -> str:
    """Where a source lies, however it is written."""
    return source if source.startswith("procedural:") else str(Path(source).resolve())


def prepare_run(job: Job) -> None:
    """Make the run's group and write the role of each captured view."""
    store = SceneStore.open(job.store_path, "r+")
    run = store.run(job.run, create=True)
    roles = np.zeros(len(job.capture()), np.uint8)
    for role in ("train", "test"):
        roles[job.split[role]] = ROLES[role]
    if not np.array_equal(_stored_roles(run), roles):
        run.write("role", roles)
    run.set_attrs(job=job.model_copy(update={"store": None, "results": None}).model_dump(mode="json"))


def _stored_roles(run: Run) -> np.ndarray:
    """The role of each captured view as it is stored, none where it is not or cannot be read: no stage makes it again,
    so damage to it is mended here."""
    try:
        return run.read("role")
    except StoreError:
        return np.zeros(0, np.uint8)
