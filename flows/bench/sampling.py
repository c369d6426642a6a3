"""Benchmark of the fan-out: speed-up and overhead of worker processes and of a Dask cluster, costs of the parts.

`python -m flows.bench.sampling WORK [--model FILE] [--groups 24]` prints what
`docs/explanation/scaling.md` calculates with.
  share    wall time, workers' busy seconds, overhead = workers * wall / busy - 1, of sampling real groups, by executor;
           share_of_limit of the network's operations in the busy seconds (`limits`)
  batch    seconds a batch costs apart from its groups: handed groups that are done already, a worker only looks
  store    operations per second on the store: latents written, marks written, marks read; share_of_limit of the bytes
           of latents as one large file
"""

from __future__ import annotations

import argparse
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch

from flows.bench import limits
from flows.generation.groups import StoredPlan
from flows.jobs.job import Job
from flows.jobs.request import Request, make_config
from flows.pipeline.runner import opened, run_missing
from flows.pipeline.server import prefect_server
from flows.stages.sample import sample_work, sampling_flops
from flows.workers.executors import open_executor
from flows.workers.fan_out import fan_out
from flows.workers.work import is_done
from schemas.scene_store import SceneStore

SOURCE = "procedural:dtu/3?views=9&width=64&height=64"


def prepared(work: Path, model: Path | None, groups: int) -> Job:
    """A job whose store is ready to be sampled: 5 views a group."""
    settings = [f"plan.views={5 * groups}", "method=cat3d", *([f"sample.checkpoint={model}"] if model else [])]
    job = Request(SOURCE, work, ("3",), make_config({}, None, settings)).jobs()[0]
    with opened(job):
        for stage in ("plan", "encode"):
            run_missing(job, until=stage)
    return job


def with_execution(job: Job, **execution: Any) -> Job:
    """The same job, worked on in another way."""
    settings = job.config.execution.model_copy(update=execution)
    return job.model_copy(update={"config": job.config.model_copy(update={"execution": settings})})


def share_row(job: Job, executor: str, workers: int) -> dict[str, Any]:
    """Sample everything anew."""
    job = with_execution(job, executor=executor, workers=workers)
    store = SceneStore.open(job.store_path, "r+")
    for name in ("latent", "done_latent"):
        store.run(job.run).generated.remove(name)
    work = sample_work(job, store, "0" * 64)
    started = time.monotonic()
    totals = fan_out([work], job.config.execution, f"{executor} {workers}")
    wall = time.monotonic() - started
    return {
        "what": "share", "executor": executor, "workers": workers, "groups": len(work.views), "wall_s": wall,
        "busy_s": totals.busy_seconds, "loading_s": totals.loading_seconds, "batches": totals.batches,
        "overhead": workers * wall / totals.busy_seconds - 1, **network_share(job, store, totals.busy_seconds),
    }  # fmt: skip


def network_share(job: Job, store: SceneStore, seconds: float) -> dict[str, Any]:
    """Of sampling all groups, on the threads of a worker: the limit is measured here and now, without other workers."""
    flops, threads = (
        sampling_flops(job, StoredPlan(store, store.run(job.run), job.config.seed)),
        torch.get_num_threads(),
    )
    torch.set_num_threads(job.config.execution.threads)
    try:
        return limits.columns(limits.Work(flops), seconds)
    finally:
        torch.set_num_threads(threads)


def batch_row(job: Job, executor: str, count: int = 40) -> dict[str, Any]:
    """Hand out batches of one group that is done already, one after another; the store must be sampled."""
    job = with_execution(job, executor=executor, workers=1)
    work = sample_work(job, SceneStore.open(job.store_path, "r+"), "0" * 64)
    started = time.monotonic()
    open_one = open_executor(job.config.execution, job.out / ".work")
    try:
        times: list[float] = []
        for number in range(count):
            sent = time.monotonic()
            open_one.submit(work.batch(number, (0,)))
            while not (answers := open_one.answers(60)):
                pass
            answers[0].raise_error()
            times.append(time.monotonic() - sent)
            if number == 0:
                start_up, first_cpu = time.monotonic() - started, time.process_time()
        cpu = (time.process_time() - first_cpu) / (count - 1)
    finally:
        open_one.close()
    rest = np.array(times[1:])
    return {
        "what": "batch", "executor": executor, "first_s": start_up, "median_s": float(np.median(rest)),
        "p90_s": float(np.quantile(rest, 0.9)), "in_worker_s": answers[0].seconds,
        "parent_cpu_s": cpu,
    }  # fmt: skip


def store_rows(job: Job, folder: Path, views: int = 400) -> Iterator[dict[str, Any]]:
    """The operations a group needs, at paper size (64 x 64 x 8 latents), one after another in one process."""
    store = SceneStore.create(folder / "bench.zarr", "bench", "bench", {})
    generated = store.run("r", create=True).generated
    generated.create_array("latent", (views, 8, 64, 64))
    generated.create_array("done_latent", (views, 32))
    latent = np.random.default_rng(0).normal(size=(1, 8, 64, 64)).astype(np.float16)
    operations = {
        "latent written": lambda v: generated.write_views("latent", latent, [v]),
        "mark written": lambda v: generated.mark_done("done_latent", ["0" * 64], [v]),
        "mark read": lambda v: is_done(generated, "done_latent", v, "0" * 64),
        "latent read": lambda v: generated.read("latent", [v]),
    }
    for name, operation in operations.items():
        started, started_cpu = time.monotonic(), time.process_time()
        for view in range(views):
            operation(view)
        wall, cpu = time.monotonic() - started, time.process_time() - started_cpu
        row = {"what": "store", "operation": name, "wall_ms": 1000 * wall / views, "cpu_ms": 1000 * cpu / views}
        if name.startswith("latent"):
            written, read = (latent.nbytes * (name == f"latent {what}") for what in ("written", "read"))
            row |= limits.file_columns(written, read, wall / views, folder)
        yield row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("work", type=Path)
    parser.add_argument("--model", type=Path)
    parser.add_argument("--groups", type=int, default=24)
    parser.add_argument("--executors", default="local:1,local:2,dask:2")
    arguments = parser.parse_args()
    work = arguments.work.resolve()
    shutil.rmtree(work / "bench.zarr", ignore_errors=True)
    with prefect_server(work / ".prefect"):
        job = prepared(work, arguments.model and arguments.model.resolve(), arguments.groups)
        for row in store_rows(job, work):
            print(row, flush=True)
        chosen = [text.split(":") for text in arguments.executors.split(",")]
        for executor, workers in chosen:
            print(share_row(job, executor, int(workers)), flush=True)
        for executor in sorted({executor for executor, _ in chosen}):
            print(batch_row(job, executor), flush=True)


if __name__ == "__main__":
    main()
