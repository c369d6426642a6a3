"""What workers are to those who share work out: small enough for processes of this machine and for a cluster alike."""

from __future__ import annotations

from collections import Counter
from typing import Protocol

from flows.jobs.needs import Needs
from flows.workers.work import Answer, Batch


class Executor(Protocol):
    """Workers that do one batch at a time.

    exclusive: after `close`, none of the workers can be writing any more.
    """

    exclusive: bool

    def workers(self, needs: Needs) -> int:
        """Workers that such work can be done on, as of now; 0 while a cluster has none of them."""
        ...

    def room(self, needs: Needs, out: Counter[Needs]) -> int:
        """How many more batches with these needs may be handed out, while as many as `out` says are."""
        ...

    def submit(self, batch: Batch) -> None:
        """Hand a batch out; only where there is room."""
        ...

    def wake(self) -> None:
        """End the wait in `answers` now; called from another thread."""
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
