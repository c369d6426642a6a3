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
import time
from collections import Counter
from typing import Any

import distributed
import torch
from distributed.scheduler import KilledWorker
from prefect import task
from prefect.cache_policies import NO_CACHE
from prefect_dask.client import PrefectDaskClient

from flows.jobs.device import worker_count
from flows.jobs.needs import Needs
from flows.workers.work import Answer, Batch, run_batch
from schemas.errors import ConfigError
from schemas.execution import ExecutionConfig

# Its chatter at INFO is for people who run schedulers. Workers inherit the environment.
os.environ.setdefault("DASK_LOGGING__DISTRIBUTED", "critical")
logging.getLogger("distributed").setLevel(logging.CRITICAL)

RESTART_TIMEOUT_S = 5
LOOK_S = 1.0  # how old what is known of the workers may be
NO_BATCH = -1
ANSWER_TIMEOUT_S = 30  # for a line of JSON from the worker that finished; one that stopped since never sends it


@task(name="cat3d-batch", task_run_name="{label}", cache_policy=NO_CACHE, persist_result=False)
def dask_batch(document: str, label: str) -> str:
    """Do a batch on a Dask worker. JSON in, JSON out."""
    name = distributed.get_worker().name
    if torch.cuda.is_available() and isinstance(name, int):  # a local cluster's workers see every GPU
        torch.cuda.set_device(name % torch.cuda.device_count())
    return run_batch(Batch.model_validate_json(document)).model_dump_json()


class DaskExecutor:
    """A cluster of its own, or a running one. Dask itself gives a dead worker's batch to another worker.

    Work without a GPU may go to any worker, so that a cluster can have cheaper ones for it; work with one goes to those
    that have the resources of the settings. Workers whose memory is too small for a batch are passed over.
    """

    def __init__(self, settings: ExecutionConfig) -> None:
        self.resources = dict(settings.dask_resources)
        self.exclusive = settings.dask_address is None
        self.cluster = None if settings.dask_address else make_cluster(settings)
        self.client = PrefectDaskClient(settings.dask_address or self.cluster, set_as_default=False)
        self.looked, self.known = -LOOK_S, dict[str, Any]()
        self.able: dict[Needs, frozenset[str]] = {}
        self.futures: dict[int, distributed.Future] = {}
        self.finished: queue.SimpleQueue[int] = queue.SimpleQueue()  # numbers of batches

    def workers(self, needs: Needs) -> int:
        return len(self._able(needs))

    def room(self, needs: Needs, out: Counter[Needs]) -> int:
        """Workers that can do it and have none of the batches that are out, as far as what those need tells."""
        able = self._able(needs)
        narrower = sum(count for other, count in out.items() if self._able(other) <= able)
        return min(len(able) - narrower, len(self.known) - out.total())

    def _able(self, needs: Needs) -> frozenset[str]:
        """Addresses of the workers that have what such work needs."""
        if time.monotonic() - self.looked > LOOK_S:
            self.looked = time.monotonic()
            self.known = self.client.scheduler_info(n_workers=-1)["workers"]
            self.able = {}
        if needs not in self.able:
            resources = self._resources(needs)
            self.able[needs] = frozenset(
                address
                for address, worker in self.known.items()
                if all(worker["resources"].get(name, 0) >= value for name, value in resources.items())
                and not 0 < worker["memory_limit"] < 0.95 * needs.memory_gb * 1e9  # 2 GB of a batch system are 1.99
            )
        return self.able[needs]

    def _places(self, needs: Needs) -> list[str] | None:
        """Addresses that the batch is kept to; None where its resources say enough."""
        able = self._able(needs)
        return None if able == self._able(needs.model_copy(update={"memory_gb": 0.0})) else sorted(able)

    def _resources(self, needs: Needs) -> dict[str, float]:
        """What a batch occupies of a worker: as set, but no GPU where it computes on none."""
        return {name: value for name, value in self.resources.items() if needs.gpu or name != "GPU"}

    def submit(self, batch: Batch) -> None:
        label = f"{batch.stage} {batch.job.scene_id} {batch.job.run} {batch.number}"
        future = self.client.submit(
            dask_batch, batch.model_dump_json(), label, resources=self._resources(batch.needs) or None,
            workers=self._places(batch.needs), pure=False,
        )  # fmt: skip
        self.futures[batch.number] = future
        future.add_done_callback(lambda _: self.finished.put(batch.number))

    def wake(self) -> None:
        self.finished.put(NO_BATCH)

    def answers(self, timeout_s: float) -> list[Answer]:
        out = []
        with contextlib.suppress(queue.Empty):
            number = self.finished.get(timeout=timeout_s)
            while True:
                if number in self.futures:  # else it was taken back, or is NO_BATCH
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
    if settings.workers:  # not `scale`: jobs that a batch system ends, as at their time limit, are to be replaced
        cluster.adapt(minimum=settings.workers, maximum=settings.workers)
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
