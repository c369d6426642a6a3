"""The queue alone, with an executor whose workers are lost as the test says."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from flows.bench.scheduling import Clock, SimulatedExecutor, SimulatedWork
from flows.errors import WorkerError
from flows.jobs.job import Job
from flows.progress import meter
from flows.workers.orders import Order
from flows.workers.sharing import Sharing
from flows.workers.work import Answer, Batch, Sign
from schemas.config import RunConfig
from schemas.execution import ExecutionConfig


class Losing(SimulatedExecutor):
    """One worker, which is lost at its first `losses` batches."""

    def __init__(self, losses: int, clock: Clock) -> None:
        super().__init__(1, clock, 0.0)
        self.losses, self.batches, self.given = losses, 0, list[int]()
        self.seen = False

    def submit(self, batch: Batch) -> None:
        self.batches += 1
        self.given.append(batch.number)

    def answers(self, timeout_s: float) -> list[Answer]:
        """Every second time, so that signs of life are seen in between."""
        self.clock.now += 10
        self.seen = not self.seen
        if self.seen:
            return []
        died = "was lost" if self.batches <= self.losses else ""
        answers = [Answer(number=number, seconds=1.0, died=died) for number in self.given]
        self.given.clear()
        return answers


class Signing(SimulatedWork):
    """Work whose worker says how far it is."""

    reached: Callable[[], int]

    def sign(self, item: int) -> Sign | None:
        return Sign(0, self.reached(), 100, "")


def work_lost(losses: int, further: bool) -> Order:
    """An item whose worker is lost so often, each time further or not."""
    clock = Clock()
    executor = Losing(losses, clock)
    job = Job(source="procedural:none/1", out=Path("/nowhere"), scene_id="s", dataset="none", config=RunConfig())
    work = Signing(job, "reconstruct", 1.0, 1)
    work.reached = lambda: executor.batches if further else 1
    sharing = Sharing(executor, clock=clock)
    with meter("work", 1, quiet=True) as progress:
        order = Order([work], ExecutionConfig(attempts=3, timeout_s=1e9), progress)
        sharing.place(order)
        sharing.run(order.over.is_set)
    return order


def test_work_that_gets_further_each_time_may_be_lost_more_often_than_work_that_does_not() -> None:
    assert work_lost(2, further=False).error is None
    error = work_lost(3, further=False).error
    assert isinstance(error, WorkerError)
    assert "3 workers were lost on item 0 of reconstruct" in str(error)
    assert work_lost(20, further=True).error is None


@pytest.mark.parametrize("losses", [0, 1])
def test_what_was_lost_is_said(losses: int) -> None:
    order = work_lost(losses, further=False)
    assert [d.text for d in order.totals.decisions] == [
        "A worker was lost; its 1 unfinished items of reconstruct were handed to another."
    ] * losses
