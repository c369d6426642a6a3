"""Workers of a Dask cluster, reached through prefect-dask: on this machine, over SSH, SLURM, Kubernetes.

A batch is a Prefect task that runs on the cluster. Workers share the file system of the stores, have cat3d installed,
reach the Prefect server (PREFECT_API_URL), and are started with the resources that `dask_resources` names.
"""

from __future__ import annotations

import contextlib
import importlib
import logging
import os
import queue
from typing import Any

import distributed
import torch
from distributed.scheduler import KilledWorker
from prefect import task
from prefect.cache_policies import NO_CACHE
from prefect_dask.client import PrefectDaskClient

from flows.jobs.device import worker_count
from flows.workers.work import Answer, Batch, run_batch
from schemas.config import ExecutionConfig
from schemas.errors import ConfigError

# Its chatter at INFO is for people who run schedulers. Workers inherit the environment.
os.environ.setdefault("DASK_LOGGING__DISTRIBUTED", "critical")
logging.getLogger("distributed").setLevel(logging.CRITICAL)

RESTART_TIMEOUT_S = 5
ANSWER_TIMEOUT_S = 30  # for a line of JSON from the worker that finished; one that stopped since never sends it


@task(name="cat3d-batch", task_run_name="{label}", cache_policy=NO_CACHE, persist_result=False)
def dask_batch(document: str, label: str) -> str:
    """Do a batch on a Dask worker. JSON in, JSON out."""
    name = distributed.get_worker().name
    if torch.cuda.is_available() and isinstance(name, int):  # a local cluster's workers see every GPU
        torch.cuda.set_device(name % torch.cuda.device_count())
    return run_batch(Batch.model_validate_json(document)).model_dump_json()


class DaskExecutor:
    """A cluster of its own, or a running one. Dask itself gives a dead worker's batch to another worker."""

    ahead = 1  # a task's way through Prefect and Dask takes 0.1 s and more, see docs/explanation/scaling.md

    def __init__(self, settings: ExecutionConfig) -> None:
        self.resources = dict(settings.dask_resources)
        self.exclusive = settings.dask_address is None
        self.cluster = None if settings.dask_address else make_cluster(settings)
        self.client = PrefectDaskClient(settings.dask_address or self.cluster, set_as_default=False)
        if self.cluster is None:
            self.client.wait_for_workers(1, timeout=settings.timeout_s)
        self.futures: dict[int, distributed.Future] = {}
        self.finished: queue.SimpleQueue[int] = queue.SimpleQueue()  # numbers of batches

    def workers(self) -> int:
        """Those that have the resources; at least one, as a cluster may only be starting."""
        known = self.client.scheduler_info(n_workers=-1)["workers"].values()
        able = [w for w in known if all(w["resources"].get(n, 0) >= v for n, v in self.resources.items())]
        return max(1, len(able))

    def submit(self, batch: Batch) -> None:
        label = f"{batch.stage} {batch.job.scene_id} {batch.number}"
        future = self.client.submit(
            dask_batch, batch.model_dump_json(), label, resources=self.resources or None, pure=False
        )
        self.futures[batch.number] = future
        future.add_done_callback(lambda _: self.finished.put(batch.number))

    def answers(self, timeout_s: float) -> list[Answer]:
        out = []
        with contextlib.suppress(queue.Empty):
            number = self.finished.get(timeout=timeout_s)
            while True:
                if number in self.futures:  # else it was taken back
                    out.append(_answer(number, self.futures.pop(number)))
                number = self.finished.get_nowait()
        return out

    def take_back(self, batch: Batch) -> list[int]:
        future = self.futures.pop(batch.number)
        holders = {address: keys for address, keys in self.client.processing().items() if future.key in keys}
        future.cancel(force=True)
        if holders:
            # A hanging process does not end by itself: after most of the timeout its nanny kills it.
            self.client.restart_workers(list(holders), timeout=RESTART_TIMEOUT_S, raise_for_error=False)
        waiting = {key for keys in holders.values() for key in keys}
        return [number for number, other in self.futures.items() if other.key in waiting]

    def close(self) -> None:
        for future in self.futures.values():
            future.cancel(force=True)
        self.client.close()
        if self.cluster is not None:
            self.cluster.close()


def make_cluster(settings: ExecutionConfig) -> Any:
    """Start the cluster the settings name. Raises ConfigError for a class that isn't there."""
    count = worker_count(settings)
    if settings.dask_cluster is None:
        # Loopback only: by default the dashboard and, without processes, a worker port listen on all addresses.
        defaults = {
            "n_workers": count, "threads_per_worker": 1, "processes": True, "host": "127.0.0.1",
            "dashboard_address": "127.0.0.1:0", "silence_logs": logging.CRITICAL, "resources": settings.dask_resources,
        }  # fmt: skip
        return distributed.LocalCluster(**(defaults | settings.dask_options))
    module, _, name = settings.dask_cluster.rpartition(".")
    try:
        kind = getattr(importlib.import_module(module), name)
    except (ImportError, ValueError, AttributeError):
        raise ConfigError(
            f"execution.dask_cluster: there is no {settings.dask_cluster} here; install its package or correct it."
        ) from None
    cluster = kind(**settings.dask_options)
    if settings.workers:
        cluster.scale(settings.workers)
    return cluster


def _answer(number: int, future: distributed.Future) -> Answer:
    if future.status == "finished":
        try:
            return Answer.model_validate_json(future.result(timeout=ANSWER_TIMEOUT_S))
        except TimeoutError:
            future.cancel(force=True)
            return Answer(number=number, died="of the Dask cluster finished a batch and stopped before it could say so")
    error = future.exception() if future.status == "error" else None
    if error is None or isinstance(error, KilledWorker):
        return Answer(number=number, died=f"of the Dask cluster was lost ({error or future.status})")
    return Answer(number=number, error=type(error).__name__, message=f"A batch failed on the Dask cluster: {error}")
