"""Sharing work out: by workers of its own, or by those that a command opened for everything it does."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from flows.jobs.job import Job
from flows.progress import Meter, meter
from flows.workers.executors import open_executor
from flows.workers.orders import Order, Totals
from flows.workers.sharing import POLL_S, Sharing
from flows.workers.work import Work, run_batch
from schemas.decisions import skipped
from schemas.execution import ExecutionConfig
from schemas.scene_store import SceneStore

#: The workers of this command, while `open_pool` is; every fan-out of its threads goes to them.
_pool: Sharing | None = None


@contextlib.contextmanager
def open_pool(settings: ExecutionConfig, log_folder: Path, priority: Callable[[Job], float]) -> Iterator[Sharing]:
    """Workers for everything that is fanned out meanwhile, in whichever thread. The thread that opened it runs it.

    log_folder: for the logs of workers. priority(job): whose work is done first. However it ends, whoever waits for his
    work is let go with WorkerError, and the workers end.
    """
    global _pool
    executor = open_executor(settings, log_folder)
    sharing = Sharing(executor, priority)
    _pool = sharing
    try:
        yield sharing
    finally:
        _pool = None
        sharing.stop()
        executor.close()


def pool_is_open() -> bool:
    """Whether work is shared out by this command's one set of workers."""
    return _pool is not None


def fan_out(works: Sequence[Work], settings: ExecutionConfig, label: str, here: bool = False) -> Totals:
    """Do all works, of one scene or of many, on the workers the settings ask for; on the pool's where one is open.

    here: do without workers what takes no longer than one batch, unless the settings say how many there are.
    Raises the first error that a worker met and can't be cured by another worker; WorkerError when `attempts` workers
    died on one item. What is complete by then stays; workers are gone and nothing half-written is left.
    """
    size = sum(work.size(items) for work in works for items in work.passes)
    if not size:
        return Totals()
    with meter(label, size, quiet=_pool is not None) as progress:
        if _pool is not None:
            return _finished(_pool, Order(works, settings, progress))
        done = Totals()
        if here and settings.workers is None and settings.executor == "local":
            done = _done_here(works, settings, progress)
            if not any(items for work in works for items in work.passes):
                text = "Started no workers: this process did it in less than a batch takes."
                done.decisions.append(skipped(text, "workers"))
                return done
        return done + _alone(Order(works, settings, progress))


def _finished(pool: Sharing, order: Order) -> Totals:
    """What the pool did, when it is done."""
    pool.place(order)
    order.over.wait()
    if order.error is not None:
        raise order.error
    return order.totals


def _alone(order: Order) -> Totals:
    """Do an order with workers of its own."""
    executor = open_executor(order.settings, order.works[0].job.out / ".work")
    sharing = Sharing(executor)
    sharing.place(order)
    try:
        sharing.run(lambda: order.over.is_set() or order.error is not None)
    finally:
        executor.close()
        if executor.exclusive:
            for path in {work.job.store_path for work in order.works}:
                SceneStore.open(path, "r+").sweep()
    if order.error is not None:
        raise order.error
    return order.totals


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
                progress.advance(work.size(batch))
                totals += Totals(1, 1, answer.seconds, answer.loading_seconds, usage=answer.usage)
                each = answer.seconds / len(batch)
                if each * sum(len(items) for work in works for items in work.passes) > settings.batch_seconds:
                    return totals
                count = max(settings.groups_at_once, int(POLL_S / max(each, 1e-9)))
    return totals
