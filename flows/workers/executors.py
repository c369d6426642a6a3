"""Where batches run: an interface small enough for processes of this machine and for a cluster alike."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

from flows.workers.work import Answer, Batch
from schemas.config import ExecutionConfig


class Executor(Protocol):
    """Workers that do one batch at a time.

    ahead: batches that may wait for each worker while it is busy, where handing one out takes long.
    exclusive: after `close`, none of the workers can be writing any more.
    """

    ahead: int
    exclusive: bool

    def workers(self) -> int:
        """Batches that can be worked on at once, as of now."""
        ...

    def submit(self, batch: Batch) -> None:
        """Hand a batch out; only while fewer than workers() * (1 + ahead) are out."""
        ...

    def answers(self, timeout_s: float) -> list[Answer]:
        """What came back, waiting at most timeout_s for something to come."""
        ...

    def take_back(self, batch: Batch) -> list[int]:
        """Give up the worker that has this batch, hanging as it may be; no answer to it will count.

        Returns the numbers of other batches that waited there: they go on elsewhere by themselves.
        """
        ...

    def close(self) -> None:
        """End all workers, whatever they are doing."""
        ...


def open_executor(settings: ExecutionConfig, log_folder: Path) -> Executor:
    """The executor the settings ask for. log_folder: for the logs of workers."""
    if settings.executor == "dask":
        from flows.workers.dask_executor import DaskExecutor  # takes a second to import

        return DaskExecutor(settings)
    from flows.workers.local import LocalExecutor

    return LocalExecutor(settings, log_folder)
