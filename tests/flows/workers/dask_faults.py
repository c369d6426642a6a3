"""Every call that our code makes to Dask goes through one counter, which lets a chosen one fail as the library does."""

from __future__ import annotations

import functools
import signal
import sys
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import distributed
from distributed.client import ClosedClientError, FutureCancelledError
from distributed.comm.core import CommClosedError
from prefect_dask.client import PrefectDaskClient

CALLER = "flows.workers.dask_executor"  # what the library calls of itself is not counted

_CLOSED = CommClosedError("in <TCP (closed) ConnectionPool local=tcp://127.0.0.1:1 remote=tcp://127.0.0.1:2>: closed")
_LATE = TimeoutError("timed out after 30 s.")
_NO_CLIENT = ClosedClientError("Client is closed. Can't send update-graph message.")
_CANCELLED = FutureCancelledError("cat3d-batch", "scheduler-connection-lost", "Client lost the connection.")
_NO_NANNY = ValueError("Restarting workers requires a nanny to be used. Worker tcp://127.0.0.1:1 has type Worker.")
_NOT_STARTED = RuntimeError("Cluster failed to start: Nanny failed to start worker process")

LIMIT_S = 120  # for a run of seconds
#: Workers of a cluster in this process, so that their calls are counted too.
HERE = {"processes": False, "protocol": "tcp", "host": "127.0.0.1", "threads_per_worker": 1,
        "dashboard_address": "127.0.0.1:0", "silence_logs": 50}  # fmt: skip
#: Where each call is looked up, and what it raises: one after the other, call by call.
POINTS: dict[str, tuple[Any, str, list[Exception]]] = {
    "LocalCluster": (distributed.LocalCluster, "__init__", [_NOT_STARTED, _LATE, OSError(98, "Address in use")]),
    "adapt": (distributed.LocalCluster, "adapt", [_LATE]),
    "LocalCluster.close": (distributed.LocalCluster, "close", [_LATE]),
    "Client": (PrefectDaskClient, "__init__", [OSError("Timed out trying to connect to tcp://127.0.0.1:1 after 30 s")]),
    "scheduler_info": (PrefectDaskClient, "scheduler_info", [_CLOSED, _LATE]),
    "submit": (PrefectDaskClient, "submit", [_NO_CLIENT, _CLOSED]),
    "processing": (PrefectDaskClient, "processing", [_CLOSED, _LATE]),
    "restart_workers": (PrefectDaskClient, "restart_workers", [_LATE, _NO_NANNY, _CLOSED]),
    "Client.close": (PrefectDaskClient, "close", [_LATE, _CLOSED]),
    "add_done_callback": (distributed.Future, "add_done_callback", [_NO_CLIENT]),
    "result": (distributed.Future, "result", [_CLOSED, _LATE, _CANCELLED]),
    "exception": (distributed.Future, "exception", [_CANCELLED]),
    "cancel": (distributed.Future, "cancel", [_NO_CLIENT]),
    "get_worker": (distributed, "get_worker", [ValueError("No worker found")]),
}  # fmt: skip


@contextmanager
def limited(seconds: float) -> Iterator[None]:
    """Raise in the middle of whatever takes longer."""

    def over(*_: object) -> None:
        raise AssertionError(f"still not over after {seconds} s")

    before = signal.signal(signal.SIGALRM, over)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


class Calls:
    """counted: calls of each name since `fail` was told. failed: what was raised, once."""

    def __init__(self) -> None:
        self.lock = threading.Lock()  # workers of this process call too
        self.fail()

    def fail(self, *points: tuple[str, int], error: int | None = None) -> None:
        """Let these calls fail: a name, and how many-th call of it (from 1). error: which of its errors is raised."""
        self.chosen, self.error = set(points), error
        self.counted, self.failed = Counter[str](), list[Exception]()

    def _met(self, name: str, errors: list[Exception]) -> None:
        with self.lock:
            self.counted[name] += 1
            number = self.counted[name]
            if (name, number) in self.chosen:
                self.failed.append(errors[(number - 1 if self.error is None else self.error) % len(errors)])
                raise self.failed[-1].with_traceback(None)

    @contextmanager
    def watched(self) -> Iterator[Calls]:
        """Count and fail inside."""
        before = [(owner, attribute, vars(owner).get(attribute)) for owner, attribute, _ in POINTS.values()]
        try:
            for name, (owner, attribute, errors) in POINTS.items():
                setattr(owner, attribute, self._through(name, getattr(owner, attribute), errors))
            yield self
        finally:
            for owner, attribute, own in before:
                setattr(owner, attribute, own) if own is not None else delattr(owner, attribute)

    def _through(self, name: str, call: Callable[..., Any], errors: list[Exception]) -> Callable[..., Any]:
        @functools.wraps(call)
        def counted(*arguments: Any, **options: Any) -> Any:
            if sys._getframe(1).f_globals.get("__name__") == CALLER:
                self._met(name, errors)
            return call(*arguments, **options)

        return counted
