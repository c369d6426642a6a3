"""How the sharing out of a sweep scales: its real queue with simulated workers and a simulated clock.

`python -m flows.bench.scheduling --workers 1 16 256 4096` prints, for sweeps of so many runs that each worker has
several, the time they take, the share of it in which workers have nothing to do, and what the command's own
queueing costs: seconds of one core a batch, measured, as the queue is the one that runs in earnest. The latency and
the command's other costs of a batch are measured ones and given: --latency, --command (docs/explanation/scaling.md).
"""

from __future__ import annotations

import argparse
import heapq
import itertools
import random
import threading
import time
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from flows.jobs.job import Job
from flows.jobs.needs import Needs
from flows.progress import meter
from flows.workers.orders import Order
from flows.workers.sharing import Sharing
from flows.workers.work import Answer, Batch, Work
from schemas.config import RunConfig
from schemas.execution import ExecutionConfig

#: The stages of a run in the order they run: seconds (of an item; those of the sample are groups), whether a scene's.
STAGES = (
    ("ingest", 2.0, True), ("poses", 5.0, True), ("plan", 1.0, False), ("sample", 2.5, False), ("decode", 0.5, False),
    ("reconstruct", 600.0, False), ("render", 20.0, False), ("evaluate", 10.0, False),
)  # fmt: skip
GROUPS, SPREAD = 16, 0.3


class Clock:
    """The time of the simulation, seconds."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


class SimulatedWork(Work):
    """A stage that takes `seconds` an item and is done when the clock says so."""

    def __init__(self, job: Job, stage: str, seconds: float, count: int) -> None:
        super().__init__(job, stage, "", Needs(gpu=True), _nothing, _nothing, [range(count)])
        self.seconds = seconds

    def size(self, items: Iterable[int]) -> int:
        return len(list(items))

    def finished(self, item: int) -> bool:
        return False


def _nothing(*_: Any) -> None:
    pass


class SimulatedExecutor:
    """Workers that do a batch in the seconds of its items, and answer after the latency of a cluster."""

    exclusive = True

    def __init__(self, count: int, clock: Clock, latency_s: float) -> None:
        self.count, self.clock, self.latency_s = count, clock, latency_s
        self.ends: list[tuple[float, int, float]] = []  # when, which batch, how long it took
        self.seconds: dict[str, float] = {}  # of an item of the work that is named
        self.busy = 0.0

    def workers(self, needs: Needs) -> int:
        return self.count

    def room(self, needs: Needs, out: Counter[Needs]) -> int:
        return self.count - out.total()

    def submit(self, batch: Batch) -> None:
        took = self.seconds[f"{batch.job.scene_id} {batch.job.config.seed} {batch.stage}"] * len(batch.items)
        self.busy += took
        heapq.heappush(self.ends, (self.clock.now + took + self.latency_s, batch.number, took))

    def answers(self, timeout_s: float) -> list[Answer]:
        """The next ones that end; the clock goes there."""
        if not self.ends:
            return []
        self.clock.now = max(self.clock.now, self.ends[0][0])
        out = []
        while self.ends and self.ends[0][0] <= self.clock.now:
            _, number, took = heapq.heappop(self.ends)
            out.append(Answer(number=number, seconds=took))
        return out

    def wake(self) -> None:
        pass

    def take_back(self, batch: Batch) -> list[int]:
        return []

    def close(self) -> None:
        pass


class _Told(threading.Event):
    """An event that is written down when it happens."""

    def __init__(self, ended: list[threading.Event]) -> None:
        super().__init__()
        self.ended = ended

    def set(self) -> None:
        if not self.is_set():
            self.ended.append(self)
        super().set()


class _Runs:
    """The runs of a sweep, which place their next order as soon as the last one is over."""

    def __init__(self, scenes: int, runs: int, sharing: Sharing, executor: SimulatedExecutor, clock: Clock) -> None:
        self.sharing, self.executor, self.clock = sharing, executor, clock
        rng = random.Random(0)
        self.settings = ExecutionConfig(timeout_s=1e9)
        self.at: dict[threading.Event, tuple[Job, list[tuple[str, float]]]] = {}
        self.ended: list[threading.Event] = []
        self.left: dict[str, float] = {}
        self.waiting: dict[str, list[tuple[Job, list[tuple[str, float]]]]] = {}
        for scene, run in itertools.product(range(scenes), range(runs)):
            job = Job(source="procedural:none/1", out=Path("/nowhere"), scene_id=f"s{scene}", dataset="none",
                      config=RunConfig(seed=run))  # fmt: skip
            slow = rng.lognormvariate(0, SPREAD)
            stages = [(name, seconds * slow) for name, seconds, shared in STAGES if run == 0 or not shared]
            self.left[self._name(job)] = sum(seconds * (GROUPS if name == "sample" else 1) for name, seconds in stages)
            if run == 0:
                self._next(job, stages)
            else:
                self.waiting.setdefault(job.scene_id, []).append((job, stages))

    @staticmethod
    def _name(job: Job) -> str:
        return f"{job.scene_id} {job.config.seed}"

    def priority(self, job: Job) -> float:
        """Seconds that are left of the run."""
        return self.left[self._name(job)]

    def _next(self, job: Job, stages: list[tuple[str, float]]) -> None:
        (name, seconds), rest = stages[0], stages[1:]
        count = GROUPS if name in ("sample", "decode") else 1
        self.executor.seconds[f"{self._name(job)} {name}"] = seconds
        with meter(name, count, quiet=True) as progress:
            order = Order([SimulatedWork(job, name, seconds, count)], self.settings, progress, self.clock)
        self.left[self._name(job)] -= seconds * count
        order.over = _Told(self.ended)
        self.at[order.over] = (job, rest)
        self.sharing.place(order)

    def over(self) -> bool:
        """Go on with every run whose order is over; whether nothing is left."""
        while self.ended:
            job, rest = self.at.pop(self.ended.pop())
            if rest:
                self._next(job, rest)
            if rest and rest[0][0] == "plan":  # the scene's own stages are done: its other runs begin
                for other, stages in self.waiting.pop(job.scene_id, []):
                    self._next(other, stages)
        return not self.at


def simulate(workers: int, runs_a_worker: float, latency_s: float, command_s: float) -> dict[str, Any]:
    """One sweep: 12 runs a scene."""
    clock = Clock()
    executor = SimulatedExecutor(workers, clock, latency_s)
    sharing = Sharing(executor, clock=clock)
    runs = _Runs(max(1, round(workers * runs_a_worker / 12)), 12, sharing, executor, clock)
    sharing.priority = runs.priority
    began = time.process_time()
    sharing.run(runs.over)
    queueing = time.process_time() - began
    batches = sharing.number
    return {
        "workers": workers, "runs": len(runs.left), "batches": batches, "hours": clock.now / 3600,
        "idle": 1 - executor.busy / (workers * clock.now), "queueing_ms": 1000 * queueing / batches,
        "command_busy": (queueing + command_s * batches) / clock.now,
    }  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 16, 256, 4096])
    parser.add_argument("--runs-a-worker", type=float, default=4.0)
    parser.add_argument("--latency", type=float, default=0.1, help="seconds from handing a batch out to its begin")
    parser.add_argument("--command", type=float, default=0.049, help="seconds of a core a batch costs the command")
    given = parser.parse_args(arguments)
    for workers in given.workers:
        print(simulate(workers, given.runs_a_worker, given.latency, given.command), flush=True)


if __name__ == "__main__":
    main()
