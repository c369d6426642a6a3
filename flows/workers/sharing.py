"""Which batch goes to which worker next, what is taken back from dead and hanging workers, and progress.

The store says what is done; a worker's answer only says that it is free again. So nothing depends on who did what.
"""

from __future__ import annotations

import math
import queue
import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass

from flows.errors import WorkerError
from flows.jobs.job import Job
from flows.jobs.needs import Needs
from flows.progress import console
from flows.workers.orders import Clock, Order, Waiting
from flows.workers.protocol import Executor
from flows.workers.work import Answer, Batch, Sign, Work
from schemas.decisions import warning
from schemas.execution import ExecutionConfig

POLL_S = 1.0
#: Looking at the store for progress takes at most this share of the time, however many batches are out.
WATCHING_SHARE = 0.05
#: How often it is said that there is no worker yet.
SAY_S = 60.0


@dataclass
class _Out:
    """A batch that a worker has: the items it hasn't finished yet, and when it last showed that it is at work."""

    order: Order
    w: int
    batch: Batch
    left: deque[int]
    seen: float
    sign: Sign | None = None

    @property
    def work(self) -> Work:
        return self.order.works[self.w]


def _no_priority(_job: Job) -> float:
    return 0.0


class Sharing:
    """Orders shared out over the workers of an executor. One thread runs it; others may place orders meanwhile.

    priority(job): orders of the job with the highest are served first.
    """

    def __init__(
        self, executor: Executor, priority: Callable[[Job], float] = _no_priority, clock: Clock = time.monotonic
    ) -> None:
        self.executor, self.priority, self.clock = executor, priority, clock
        self.incoming: queue.SimpleQueue[Order] = queue.SimpleQueue()
        self.orders: set[Order] = set()  # that are not over
        self.waiting = Waiting()
        self.out: dict[int, _Out] = {}
        self.needs: Counter[Needs] = Counter()  # of the batches that are out
        self.item_seconds: dict[str, float] = {}  # by stage
        self.number = 0
        self.most_workers = 1  # so far
        self.next_watch, self.next_say = 0.0, clock() + SAY_S / 4
        self.stopped = False

    def place(self, order: Order) -> None:
        """Take an order in, from any thread; its event `over` says when it is done."""
        self.incoming.put(order)
        self.executor.wake()
        if self.stopped:
            self.stop()

    def run(self, over: Callable[[], bool]) -> None:
        """Serve orders until `over()`, which is asked after every change."""
        while not over():
            while not self.incoming.empty():
                order = self.incoming.get()
                self.orders.add(order)
                self._consider(order)
            self._hand_out()
            if over():
                return
            for answer in self.executor.answers(POLL_S):
                self._settle(answer)
            self._watch()

    def stop(self) -> None:
        """Let everyone go who waits for an order."""
        self.stopped = True
        while not self.incoming.empty():
            self.orders.add(self.incoming.get())
        for order in list(self.orders):
            order.fail(WorkerError("The work was stopped; run the same command again to go on."))
            order.over.set()

    def _consider(self, order: Order) -> None:
        """After a change: let the order wait for workers if it has something for them, let it go if it is over."""
        order.settle()
        if order.over.is_set():
            self.orders.discard(order)
            self.waiting.forget(order)
        elif order.ready_works():
            self.waiting.push(order, lambda: self.priority(order.works[0].job))

    def _hand_out(self) -> None:
        full: set[Needs] = set()
        while (order := self.waiting.pop(full)) is not None:
            if not self._hand_out_of(order):
                full.add(order.needs)
            self._consider(order)
        if full and not self.out and self.clock() > self.next_say:
            self.next_say = self.clock() + SAY_S
            asked = ", ".join(sorted({str(needs) for needs in full}))
            console.print(f"Waiting for workers: the cluster has none yet with what is to be done next ({asked}).")

    def _hand_out_of(self, order: Order) -> bool:
        """Hand out what is ready of an order; False where there was no room for all of it."""
        needs = order.needs
        for w in order.ready_works():
            work, items = order.works[w], order.ready(w)
            while items:
                if self.executor.room(needs, self.needs) < 1:
                    return False
                workers = self.executor.workers(needs)
                order.totals.workers = max(order.totals.workers, workers)
                self.most_workers = max(self.most_workers, workers)
                size = batch_size(order.settings, self.item_seconds.get(work.stage), len(items), workers)
                self.number += 1
                batch = work.batch(self.number, [items.popleft() for _ in range(size)])
                self.out[self.number] = _Out(order, w, batch, deque(batch.items), self.clock())
                order.out[w] += 1
                self.needs[needs] += 1
                self.executor.submit(batch)
        return True

    def _taken(self, number: int) -> _Out | None:
        """The batch is no longer out; None where it was given up on before."""
        out = self.out.pop(number, None)
        if out is not None:
            out.order.out[out.w] -= 1
            self.needs[out.work.needs] -= 1
            self.needs += Counter()  # without those of which none is out
        return out

    def _settle(self, answer: Answer) -> None:
        out = self._taken(answer.number)
        if out is None:
            return
        if answer.died:
            self._reclaim(out, answer.died)
        else:
            self._take(answer, out)
        self._consider(out.order)

    def _take(self, answer: Answer, out: _Out) -> None:
        """What a worker did, or the error it met."""
        try:
            answer.raise_error()
        except Exception as error:
            out.order.fail(error)
            return
        totals = out.order.totals
        totals.batches += 1
        totals.busy_seconds += answer.seconds
        totals.loading_seconds += answer.loading_seconds
        totals.usage = totals.usage.with_(answer.usage)
        self.item_seconds[out.work.stage] = answer.seconds / len(out.batch.items)
        _advance(out, len(out.left))

    def _watch(self) -> None:
        """See in the store what is finished; take work back from workers that finish nothing any more."""
        started = self.clock()
        if started < self.next_watch:
            return
        for number, out in list(self.out.items()):
            if number not in self.out:
                continue
            while out.left and out.work.finished(out.left[0]):
                _advance(out, 1)
            sign = out.work.sign(out.left[0]) if out.left else None
            if sign is not None and sign != out.sign:
                out.sign, out.seen = sign, self.clock()
                out.order.progress.show(sign.done, sign.total, sign.note)
            if not self.executor.workers(out.work.needs):  # all are gone: it waits for new ones
                out.seen = self.clock()
            if self.clock() - out.seen > out.order.settings.timeout_s:
                for other in self.executor.take_back(out.batch):
                    self.out[other].seen = self.clock()
                self._taken(number)
                self._reclaim(out, f"finished nothing for {out.order.settings.timeout_s:g} s")
                self._consider(out.order)
        ended = self.clock()
        self.next_watch = ended + max(POLL_S, (ended - started) / WATCHING_SHARE)

    def _reclaim(self, out: _Out, why: str) -> None:
        """Put what a lost worker left undone first in the queue again."""
        work, order = out.work, out.order
        undone = [i for i in out.left if not work.finished(i)]
        order.progress.advance(work.size(set(out.left) - set(undone)))
        sentence = f"A worker {why}; its {len(undone)} unfinished items of {work.stage} were handed to another."
        order.totals.decisions.append(warning(sentence))
        if not undone or order.error:
            return
        culprit = out.w, undone[0]
        if out.sign is not None and out.sign.done > order.furthest.get(culprit, 0):
            order.furthest[culprit] = out.sign.done
            order.deaths[culprit] = 0  # long work on jobs of limited time is lost often, and goes on each time
        order.deaths[culprit] += 1
        if order.deaths[culprit] >= order.settings.attempts:
            order.fail(WorkerError(
                f"{order.deaths[culprit]} workers were lost on item {undone[0]} of {work.stage} of {work.job.scene_id} "
                f"{work.job.run} (the last one {why}). What is done is kept; the workers' logs are in "
                f"{work.job.out / '.work'}."
            ))  # fmt: skip
            return
        order.passes[out.w][0].extendleft(reversed(undone))


def _advance(out: _Out, count: int) -> None:
    out.order.progress.advance(out.work.size([out.left.popleft() for _ in range(count)]))
    out.seen = out.order.clock()


def batch_size(settings: ExecutionConfig, item_seconds: float | None, waiting: int, workers: int) -> int:
    """Items of about batch_seconds, but fewer near the end, so that workers end together. item_seconds: None where none
    was measured yet."""
    least = settings.groups_at_once
    if item_seconds is None:
        return min(waiting, least)
    timely = int(settings.batch_seconds / max(item_seconds, 1e-9))
    return min(waiting, max(least, min(timely, math.ceil(waiting / (2 * max(1, workers))))))
