"""Sharing work out: which batch goes to which worker next, what is taken back from dead and hanging workers, progress.

The store says what is done; a worker's answer only says that it is free again. So nothing depends on who did what.
"""

from __future__ import annotations

import math
import time
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass, field

from flows.errors import WorkerError
from flows.jobs.usage import Usage
from flows.progress import Meter, meter
from flows.workers.executors import Executor, open_executor
from flows.workers.work import Answer, Batch, Work, run_batch
from schemas.config import ExecutionConfig
from schemas.decisions import Decision, skipped, warning
from schemas.scene_store import SceneStore

POLL_S = 1.0
#: Looking at the store for progress takes at most this share of the time, however many batches are out.
WATCHING_SHARE = 0.05


@dataclass
class Totals:
    """What a fan-out did. busy_seconds: workers' time on batches, without loading_seconds (the model's)."""

    workers: int = 0
    batches: int = 0
    busy_seconds: float = 0.0
    loading_seconds: float = 0.0
    decisions: list[Decision] = field(default_factory=list)
    usage: Usage = field(default_factory=Usage)

    def __add__(self, other: Totals) -> Totals:
        summed = {n: getattr(self, n) + getattr(other, n) for n in vars(self) if n not in ("workers", "usage")}
        return Totals(max(self.workers, other.workers), **summed, usage=self.usage.with_(other.usage))

    def work(self) -> dict[str, float]:
        """Counts for the stage's record."""
        counts = ("workers", "batches", "busy_seconds", "loading_seconds")
        return {name: getattr(self, name) for name in counts if self.workers}


@dataclass
class _Out:
    """A batch that a worker has: the items it hasn't finished yet, and when it last finished one."""

    work: int
    batch: Batch
    left: deque[int]
    seen: float


def fan_out(works: Sequence[Work], settings: ExecutionConfig, label: str, here: bool = False) -> Totals:
    """Do all works, of one scene or of many, on the workers the settings ask for.

    here: do without workers what takes no longer than one batch, unless the settings say how many there are.
    Raises the first error that a worker met and can't be cured by another worker; WorkerError when `attempts` workers
    died on one item. What is complete by then stays; workers are gone and nothing half-written is left.
    """
    views = sum(len(work.views[i]) for work in works for items in work.passes for i in items)
    if not views:
        return Totals()
    folder, done = works[0].job.out / ".work", Totals()
    with meter(label, views) as progress:
        if here and settings.workers is None and settings.executor == "local":
            done = _done_here(works, settings, progress)
            if not any(items for work in works for items in work.passes):
                text = "Started no workers: this process did it in less than a batch takes."
                done.decisions.append(skipped(text, "workers"))
                return done
        executor = open_executor(settings, folder)
        sharing = _Sharing(works, executor, settings, progress)
        try:
            sharing.run()
        finally:
            executor.close()
            if executor.exclusive:
                for path in {work.job.store_path for work in works}:
                    SceneStore.open(path, "r+").sweep()
    return done + sharing.totals


def _done_here(works: Sequence[Work], settings: ExecutionConfig, progress: Meter) -> Totals:
    """Do items in this process while all that is left would take no longer than `batch_seconds`, and take them off."""
    totals = Totals()
    count = settings.groups_at_once
    for work in works:
        for items in work.passes:
            while items:
                batch = tuple(items[:count])
                answer = run_batch(work.batch(0, batch))
                answer.raise_error()
                del items[: len(batch)]
                progress.advance(sum(len(work.views[i]) for i in batch))
                totals += Totals(1, 1, answer.seconds, answer.loading_seconds, usage=answer.usage)
                each = answer.seconds / len(batch)
                if each * sum(len(items) for work in works for items in work.passes) > settings.batch_seconds:
                    return totals
                count = max(settings.groups_at_once, int(POLL_S / max(each, 1e-9)))
    return totals


class _Sharing:
    def __init__(self, works: Sequence[Work], executor: Executor, settings: ExecutionConfig, progress: Meter) -> None:
        self.works, self.executor, self.settings, self.progress = works, executor, settings, progress
        self.passes = [deque(deque(items) for items in work.passes if items) for work in works]
        self.out: dict[int, _Out] = {}
        self.deaths: Counter[tuple[int, int]] = Counter()
        self.item_seconds: float | None = None
        self.number = 0
        self.next_watch = 0.0
        self.totals = Totals()

    def run(self) -> None:
        """Until every item of every work is done."""
        while True:
            self._hand_out()
            if not self.out:
                return
            for answer in self.executor.answers(POLL_S):
                self._settle(answer)
            self._watch()

    def _hand_out(self) -> None:
        workers = self.executor.workers()
        self.totals.workers = max(self.totals.workers, workers)
        while len(self.out) < workers * (1 + self.executor.ahead):
            ready = [w for w in range(len(self.works)) if self._queue(w)]
            if not ready:
                return
            # Works with most passes left first: their later passes wait for this one.
            chosen = max(ready, key=lambda w: (len(self.passes[w]), -w))
            queue = self._queue(chosen)
            items = [queue.popleft() for _ in range(self._batch_size(len(queue), workers))]
            work = self.works[chosen]
            self.number += 1
            batch = work.batch(self.number, items)
            self.out[self.number] = _Out(chosen, batch, deque(items), time.monotonic())
            self.executor.submit(batch)

    def _queue(self, w: int) -> deque[int]:
        """Items of work w that can be handed out now: a pass begins when the one before it is done."""
        passes = self.passes[w]
        if passes and not passes[0] and not any(out.work == w for out in self.out.values()):
            passes.popleft()
        return passes[0] if passes else deque()

    def _batch_size(self, waiting: int, workers: int) -> int:
        """Items of about batch_seconds, but fewer near the end, so that workers end together."""
        least = self.settings.groups_at_once
        if self.item_seconds is None:
            return min(waiting, least)
        timely = int(self.settings.batch_seconds / max(self.item_seconds, 1e-9))
        return min(waiting, max(least, min(timely, math.ceil(waiting / (2 * workers)))))

    def _settle(self, answer: Answer) -> None:
        out = self.out.pop(answer.number, None)
        if out is None:  # from a worker that was given up on
            return
        if answer.died:
            self._reclaim(out, answer.died)
            return
        answer.raise_error()
        self.totals.batches += 1
        self.totals.busy_seconds += answer.seconds
        self.totals.loading_seconds += answer.loading_seconds
        self.totals.usage = self.totals.usage.with_(answer.usage)
        self.item_seconds = answer.seconds / len(out.batch.items)
        self._advance(out, len(out.left))

    def _watch(self) -> None:
        """See in the store what is finished; take work back from workers that finish nothing any more."""
        started = time.monotonic()
        if started < self.next_watch:
            return
        # A batch that waits behind another has no chance to finish anything.
        patience_s = self.settings.timeout_s + self.executor.ahead * self.settings.batch_seconds
        for number, out in list(self.out.items()):
            while out.left and self.works[out.work].finished(out.left[0]):
                self._advance(out, 1)
            if time.monotonic() - out.seen > patience_s:
                for other in self.executor.take_back(out.batch):
                    self.out[other].seen = time.monotonic()
                del self.out[number]
                self._reclaim(out, f"finished nothing for {self.settings.timeout_s:g} s")
        ended = time.monotonic()
        self.next_watch = ended + max(POLL_S, (ended - started) / WATCHING_SHARE)

    def _advance(self, out: _Out, count: int) -> None:
        views = self.works[out.work].views
        self.progress.advance(sum(len(views[out.left.popleft()]) for _ in range(count)))
        out.seen = time.monotonic()

    def _reclaim(self, out: _Out, why: str) -> None:
        """Put what a lost worker left undone first in the queue again."""
        work = self.works[out.work]
        undone = [i for i in out.left if not work.finished(i)]
        self.progress.advance(sum(len(work.views[i]) for i in set(out.left) - set(undone)))
        sentence = f"A worker {why}; its {len(undone)} unfinished items of {work.stage} were handed to another."
        self.totals.decisions.append(warning(sentence))
        if not undone:
            return
        culprit = out.work, undone[0]
        self.deaths[culprit] += 1
        if self.deaths[culprit] >= self.settings.attempts:
            raise WorkerError(
                f"{self.deaths[culprit]} workers were lost on item {undone[0]} of {work.stage} of {work.job.scene_id} "
                f"{work.job.run} (the last one {why}). What is done is kept; the workers' logs are in "
                f"{work.job.out / '.work'}."
            )
        self.passes[out.work][0].extendleft(reversed(undone))
