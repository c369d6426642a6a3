"""What is wanted done, how far it is, and who is served next."""

from __future__ import annotations

import heapq
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field

from flows.jobs.needs import Needs
from flows.jobs.usage import Usage
from flows.progress import Meter
from flows.workers.work import Work
from schemas.decisions import Decision
from schemas.execution import ExecutionConfig

Clock = Callable[[], float]


@dataclass
class Totals:
    """What a fan-out did. busy_seconds: workers' time on batches, without loading_seconds (the model's); waited:
    seconds in which no worker had time for it."""

    workers: int = 0
    batches: int = 0
    busy_seconds: float = 0.0
    loading_seconds: float = 0.0
    waited: float = 0.0
    decisions: list[Decision] = field(default_factory=list)
    usage: Usage = field(default_factory=Usage)

    def __add__(self, other: Totals) -> Totals:
        summed = {n: getattr(self, n) + getattr(other, n) for n in vars(self) if n not in ("workers", "usage")}
        return Totals(max(self.workers, other.workers), **summed, usage=self.usage.with_(other.usage))

    def work(self) -> dict[str, float]:
        """Counts for the stage's record."""
        counts = ("workers", "batches", "busy_seconds", "loading_seconds")
        return {name: getattr(self, name) for name in counts if self.workers}


class Order:
    """Works that are wanted done together, of one run or of many, and ask the same of workers. over: nothing of them is
    left or under way."""

    def __init__(
        self, works: Sequence[Work], settings: ExecutionConfig, progress: Meter, clock: Clock = time.monotonic
    ) -> None:
        self.works, self.settings, self.progress, self.clock = works, settings, progress, clock
        self.passes = [deque(deque(items) for items in work.passes if items) for work in works]
        self.out: Counter[int] = Counter()  # batches that workers have, by number of the work
        self.deaths: Counter[tuple[int, int]] = Counter()  # workers lost at an item since it last got further
        self.furthest: dict[tuple[int, int], int] = {}
        self.totals = Totals()
        self.error: Exception | None = None
        self.over = threading.Event()
        self.idle_since: float | None = clock()

    @property
    def needs(self) -> Needs:
        """What each of its items asks of a worker."""
        return self.works[0].needs

    def ready_works(self) -> list[int]:
        """Works with items to hand out, those with most passes left first, as their later passes wait for this one."""
        ready = [w for w in range(len(self.works)) if self.ready(w)]
        return sorted(ready, key=lambda w: (-len(self.passes[w]), w))

    def ready(self, w: int) -> deque[int]:
        """Items of work w that can be handed out now: a pass begins when the one before it is done."""
        passes = self.passes[w]
        if passes and not passes[0] and not self.out[w]:
            passes.popleft()
        return passes[0] if passes else deque()

    def fail(self, error: Exception) -> None:
        """Hand out nothing more; the first error is the one that is raised."""
        self.error = self.error or error
        self.passes = [deque() for _ in self.works]

    def settle(self) -> None:
        """Note whether workers have something of it, and whether it is over."""
        if self.out.total():
            if self.idle_since is not None:
                self.totals.waited += self.clock() - self.idle_since
                self.idle_since = None
            return
        self.idle_since = self.idle_since or self.clock()
        if not self.ready_works():
            self.over.set()


class Waiting:
    """Orders that have items to hand out: the highest priority first, then as they came. A queue for each kind of
    needs, so that thousands that wait for one kind of worker are not looked through for another."""

    def __init__(self) -> None:
        self.queues: dict[Needs, list[tuple[float, int, Order]]] = {}
        self.ranks: dict[Order, tuple[float, int]] = {}
        self.inside: set[Order] = set()
        self.count = 0

    def push(self, order: Order, priority: Callable[[], float]) -> None:
        """Let an order wait, if it doesn't; its priority is asked for when it comes first."""
        if order in self.inside:
            return
        if order not in self.ranks:
            self.count += 1
            self.ranks[order] = (-priority(), self.count)
        self.inside.add(order)
        heapq.heappush(self.queues.setdefault(order.needs, []), (*self.ranks[order], order))

    def pop(self, without: Collection[Needs]) -> Order | None:
        """The next one to be served, but for those with needs in `without`."""
        heads = [(queue[0][:2], needs) for needs, queue in self.queues.items() if queue and needs not in without]
        if not heads:
            return None
        _, _, order = heapq.heappop(self.queues[min(heads, key=lambda head: head[0])[1]])
        self.inside.discard(order)
        return order

    def forget(self, order: Order) -> None:
        """The order is over."""
        self.ranks.pop(order, None)
