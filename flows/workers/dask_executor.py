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
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import distributed
import torch
from distributed.client import ClosedClientError
from distributed.scheduler import KilledWorker
from prefect import task
from prefect.cache_policies import NO_CACHE
from prefect_dask.client import PrefectDaskClient

from flows.errors import WorkerError
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
#: What Dask raises where a scheduler or a worker is not reached; closed connections and time-outs are OSErrors.
UNREACHED = (OSError, distributed.CancelledError, ClosedClientError)


@contextlib.contextmanager
def _reached(what: str) -> Iterator[None]:
    """Whatever cannot be reached inside is a WorkerError with a sentence."""
    try:
        yield
    except UNREACHED as error:
        raise WorkerError(
            f"{what} cannot be reached ({str(error) or type(error).__name__}). What is done is kept; run the same "
            "command again when the cluster is there."
        ) from error


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
        self.where = f"The scheduler of the Dask cluster {settings.dask_address or 'of this command'}"
        self.cluster = None if settings.dask_address else make_cluster(settings)
        try:
            self.client = connected(settings.dask_address or self.cluster, self.where)
        except BaseException:
            self._close_cluster()
            raise
        self.looked, self.known = -LOOK_S, dict[str, Any]()
        self.passed_over: set[str] = set()  # addresses of workers that hang and could not be restarted
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
            self.known = self._known()
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

    def _known(self) -> dict[str, Any]:
        """What the scheduler knows of each worker that is not passed over, by address."""
        with _reached(self.where):
            if self.client.status == "closed":  # after it tried for 30 s; asked then, it says what it knew before
                raise ClosedClientError("the connection was lost")
            workers = self.client.scheduler_info(n_workers=-1).get("workers", {})
        left = {address: worker for address, worker in workers.items() if address not in self.passed_over}
        if workers and not left:
            raise WorkerError("All workers of the Dask cluster hang, and none could be restarted: start new ones.")
        return left

    def _places(self, needs: Needs) -> list[str] | None:
        """Addresses that the batch is kept to; None where its resources say enough."""
        able = self._able(needs)
        anyone = able == self._able(needs.model_copy(update={"memory_gb": 0.0})) and not self.passed_over
        return None if anyone else sorted(able)

    def _resources(self, needs: Needs) -> dict[str, float]:
        """What a batch occupies of a worker: as set, but no GPU where it computes on none."""
        return {name: value for name, value in self.resources.items() if needs.gpu or name != "GPU"}

    def submit(self, batch: Batch) -> None:
        label = f"{batch.stage} {batch.job.scene_id} {batch.job.run} {batch.number}"
        places = self._places(batch.needs)
        with _reached(self.where):
            future = self.client.submit(
                dask_batch, batch.model_dump_json(), label, resources=self._resources(batch.needs) or None,
                workers=places, pure=False,
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
        with _reached(self.where):
            holders = {address: keys for address, keys in self.client.processing().items() if future.key in keys}
            future.cancel(force=True)
        if holders:
            try:  # A hanging process does not end by itself: after most of the timeout its nanny kills it.
                self.client.restart_workers(list(holders), timeout=RESTART_TIMEOUT_S, raise_for_error=False)
            except (*UNREACHED, ValueError):  # ValueError: it has no nanny
                self.passed_over |= set(holders)
                self.looked = -LOOK_S
        waiting = {key for keys in holders.values() for key in keys}
        return [number for number, other in self.futures.items() if other.key in waiting]

    def close(self) -> None:
        for future in self.futures.values():
            _try(partial(future.cancel, force=True))
        _try(self.client.close)
        self._close_cluster()

    def _close_cluster(self) -> None:
        if self.cluster is not None and not _try(self.cluster.close):
            self.exclusive = False  # some may still be at work, until this process ends


def _try(call: Callable[[], object]) -> bool:
    """Whether it went well. How the work ended stands already: what fails in taking leave changes nothing of it."""
    try:
        call()
    except Exception:
        return False
    return True


def connected(to: Any, where: str) -> PrefectDaskClient:
    """A client of a scheduler's address or of a cluster. Raises ConfigError for what is no address."""
    try:
        with _reached(where):
            return PrefectDaskClient(to, set_as_default=False)
    except ValueError as error:
        raise ConfigError(f"execution.dask_address: {to} is no address of a scheduler ({error}).") from None


def make_cluster(settings: ExecutionConfig) -> Any:
    """Start the cluster the settings name. Raises ConfigError for a class that isn't there, WorkerError where it does
    not start."""
    kind, options = distributed.LocalCluster, dict(settings.dask_options)
    if settings.dask_cluster is None:
        # Loopback only: by default the dashboard and, without processes, a worker port listen on all addresses.
        options = {
            "n_workers": worker_count(settings), "threads_per_worker": 1, "processes": True, "host": "127.0.0.1",
            "dashboard_address": "127.0.0.1:0", "silence_logs": logging.CRITICAL, "resources": settings.dask_resources,
        } | options  # fmt: skip
    else:
        kind = _class_of(settings.dask_cluster)
    try:
        cluster = kind(**options)
        if settings.dask_cluster and settings.workers:
            # Not `scale`: jobs that a batch system ends, as at their time limit, are to be replaced.
            _adapt(cluster, settings.workers)
    except (*UNREACHED, RuntimeError) as error:  # RuntimeError: one of its parts ended at once
        raise WorkerError(
            f"The Dask cluster {settings.dask_cluster or 'of this machine'} did not start ({error})."
        ) from error
    return cluster


def _class_of(name: str) -> Any:
    module, _, attribute = name.rpartition(".")
    try:
        return getattr(importlib.import_module(module), attribute)
    except (ImportError, ValueError, AttributeError):
        raise ConfigError(
            f"execution.dask_cluster: there is no {name} here; install its package or correct it."
        ) from None


def _adapt(cluster: Any, count: int) -> None:
    """Keep so many workers."""
    try:
        cluster.adapt(minimum=count, maximum=count)
    except BaseException:
        _try(cluster.close)
        raise


def _answer(number: int, future: distributed.Future) -> Answer:
    if future.status == "finished":
        try:
            return Answer.model_validate_json(future.result(timeout=ANSWER_TIMEOUT_S))
        except UNREACHED as unreached:
            _try(partial(future.cancel, force=True))
            why = "" if isinstance(unreached, TimeoutError) else f" ({unreached})"
            return Answer(
                number=number, died=f"of the Dask cluster finished a batch and stopped before it could say so{why}"
            )
    error: BaseException | None
    try:
        error = future.exception(timeout=ANSWER_TIMEOUT_S) if future.status == "error" else None
    except UNREACHED as unreached:
        error = unreached
    if error is None or isinstance(error, (KilledWorker, *UNREACHED)):
        return Answer(number=number, died=f"of the Dask cluster was lost ({error or future.status})")
    # What fails in the work itself comes back in an answer: this is about the worker.
    message = (
        f"A worker of the Dask cluster cannot work ({type(error).__name__}: {error}). It needs cat3d and the Prefect "
        "server at PREFECT_API_URL."
    )
    return Answer(number=number, error="WorkerError", message=message)
