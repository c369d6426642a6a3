"""Jobs of many scenes at the same time: which may run side by side, in which order, and what is left.

Runs of one scene share its photos, cameras and encoding, which one of them makes and the others wait for; from there on
they are independent. The command keeps a thread for each run, which only waits: the work is done by workers.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextvars import copy_context
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from flows.errors import WorkerError
from flows.jobs.device import cpu_threads, worker_count
from flows.jobs.job import Job
from flows.pipeline.costs import Costs, Outlook
from flows.pipeline.keys import Step, expected_steps, pending, stages_of
from flows.pipeline.runner import opened, run_missing
from flows.progress import Meter, meter, time_left
from flows.workers.fan_out import open_pool
from flows.workers.sharing import Sharing
from schemas.layout import SCENE_STAGES
from schemas.stages import StageRecord

#: Threads beyond this many wait for others to end: enough for runs to be ready before a worker is free.
THREADS_A_WORKER, FEWEST_THREADS = 2, 32

Perform = Callable[[Job, Step], StageRecord]
Advanced = Callable[[int, int, str], None]


@dataclass
class Result:
    """What was done of a job, and the error that ended it."""

    job: Job
    records: list[StageRecord] = field(default_factory=list)
    error: Exception | None = None

    def records_or_raise(self) -> list[StageRecord]:
        """The records; raises the error where there was one."""
        if self.error is not None:
            raise self.error
        return self.records


def do_jobs(
    jobs: Sequence[Job], perform: Perform, finished: Callable[[Result], None] | None = None,
    advanced: Advanced | None = None, same_threads: bool = False,
) -> list[Result]:  # fmt: skip
    """Do every missing stage of the jobs, with the execution settings of the first. An error ends its own job alone.

    perform: does one stage and returns its record. finished: called after each job, for one at a time.
    advanced(done, total, note): called after each stage, from many threads.
    same_threads: on the command's own thread too, a stage has `execution.threads`, as it would on a worker; else all.
    One job on this machine, or one worker, is done in this very thread, which a signal ends at once.
    """
    if not jobs:
        return []
    settings = jobs[0].config.execution
    doing = _Doing(jobs, perform, finished, advanced)
    if settings.executor == "local" and (len(jobs) == 1 or worker_count(settings) == 1):
        with cpu_threads(settings.threads) if same_threads else contextlib.nullcontext():
            return doing.one_by_one()
    return doing.together()


class _Doing:
    def __init__(
        self, jobs: Sequence[Job], perform: Perform, finished: Callable[[Result], None] | None,
        advanced: Advanced | None,
    ) -> None:  # fmt: skip
        self.jobs, self.perform, self.finished, self.advanced = list(jobs), perform, finished, advanced
        self.outlook = Outlook(self.jobs, [pending(job) for job in self.jobs], Costs(self.jobs[0].out))
        self.scenes: dict[Path, _Scene] = {}
        for job in self.jobs:
            self.scenes.setdefault(job.store_path, _Scene()).add(job)
        self.steps = self.outlook.steps_left()
        self.telling = threading.Lock()
        self.meter: Meter | None = None
        self.pool: Sharing | None = None

    def one_by_one(self) -> list[Result]:
        """All jobs in this thread, in their order but for waves."""
        order = sorted(self.jobs, key=lambda job: self.scenes[job.store_path].wave(job))
        results = {id(job): self.job(job) for job in order}
        return [results[id(job)] for job in self.jobs]

    def together(self) -> list[Result]:
        """All jobs on one set of workers, the longest first."""
        first = self.jobs[0]
        settings = first.config.execution
        order = sorted(self.jobs, key=lambda j: (self.scenes[j.store_path].wave(j), -self.outlook.seconds_of(j)))
        with (
            meter(f"{len(order)} runs", self.steps) as self.meter,
            open_pool(settings, first.out / ".work", self.outlook.seconds_of) as self.pool,
        ):
            most = max(FEWEST_THREADS, THREADS_A_WORKER * worker_count(settings))
            threads = ThreadPoolExecutor(min(len(order), most), "run")
            try:
                futures = {id(job): threads.submit(copy_context().run, self.job, job) for job in order}
                self._serve(self.pool, list(futures.values()))
            except BaseException:
                self.pool.stop()  # whoever waits is let go; nothing new begins
                for scene in self.scenes.values():
                    scene.stop()
                threads.shutdown(wait=True, cancel_futures=True)
                raise
            threads.shutdown()
            return [futures[id(job)].result() for job in self.jobs]

    def _serve(self, pool: Sharing, futures: list[Future[Result]]) -> None:
        """Run the pool in this thread until all threads are done."""
        for future in futures:
            future.add_done_callback(lambda _: pool.executor.wake())
        pool.run(lambda: all(future.done() for future in futures))

    def job(self, job: Job) -> Result:
        """All missing stages of one job, in order."""
        result, scene = Result(job), self.scenes[job.store_path]
        try:
            with scene.of_its_turn(job):
                result.records = run_missing(job, execute=self._execute)
        except Exception as error:
            result.error = error
        self.outlook.over(job)
        if self.finished is not None and not (self.pool is not None and self.pool.stopped):
            with self.telling:
                self.finished(result)
        return result

    def _execute(self, job: Job, step: Step) -> StageRecord:
        if step.stage in SCENE_STAGES:
            record = self.scenes[job.store_path].once(step, lambda: self.perform(job, step))
        else:
            record = self.perform(job, step)
        self.outlook.done(job, step.stage, record.seconds)
        done, left = self.steps - self.outlook.steps_left(), self.outlook.seconds_left(self._workers())
        if self.meter is not None:
            self.meter.update(done, left=left)
        if self.advanced is not None:
            self.advanced(done, self.steps, "" if left is None else time_left(left))
        return record

    def _workers(self) -> int:
        return self.pool.most_workers if self.pool is not None else 1


class _Scene:
    """The runs of one scene: its store is written by this command alone while one of them is under way."""

    def __init__(self) -> None:
        self.waves: list[dict[str, str]] = []  # the keys that the runs of a wave have in common
        self.waves_of: dict[str, int] = {}
        self.left: list[int] = []  # runs that are to be done yet, of each wave
        self.turn, self.stopped = threading.Condition(), False
        self.held = contextlib.ExitStack()
        self.users = 0
        self.made: dict[tuple[str, str], Future[StageRecord]] = {}

    def add(self, job: Job) -> None:
        """Give a run its wave. A scene keeps one version of its photos, cameras and encoding at a time, so that runs
        that want different ones come after one another."""
        wanted = shared_keys(job)
        fits = (n for n, keys in enumerate(self.waves) if all(keys.get(k, v) == v for k, v in wanted.items()))
        number = next(fits, len(self.waves))
        if number == len(self.waves):
            self.waves.append({})
            self.left.append(0)
        self.waves[number] |= wanted
        self.waves_of[job.run] = number
        self.left[number] += 1

    def stop(self) -> None:
        """Let runs go that wait for their turn."""
        with self.turn:
            self.stopped = True
            self.turn.notify_all()

    def wave(self, job: Job) -> int:
        return self.waves_of[job.run]

    @contextlib.contextmanager
    def of_its_turn(self, job: Job) -> Iterator[None]:
        """Wait for the waves before the run's; the store is open for writing inside."""
        wave = self.wave(job)
        with self.turn:
            self.turn.wait_for(lambda: self.stopped or not any(self.left[:wave]))
            if self.stopped:
                raise WorkerError("The work was stopped before this run began.")
        try:
            with self._open(job):
                yield
        finally:
            with self.turn:
                self.left[wave] -= 1
                self.turn.notify_all()

    @contextlib.contextmanager
    def _open(self, job: Job) -> Iterator[None]:
        with self.turn:
            if not self.users:
                self.held.enter_context(opened(job))
            self.users += 1
        try:
            yield
        finally:
            with self.turn:
                self.users -= 1
                if not self.users:
                    self.held.close()

    def once(self, step: Step, do: Callable[[], StageRecord]) -> StageRecord:
        """The record of a stage that is done once for the scene: the first to ask does it, the others wait for it."""
        with self.turn:
            first = (step.stage, step.key) not in self.made
            future: Future[Any] = self.made.setdefault((step.stage, step.key), Future())
        if first:
            try:
                future.set_result(do())
            except BaseException as error:
                future.set_exception(error)
        record: StageRecord = future.result()
        return record


def shared_keys(job: Job) -> dict[str, str]:
    """The content keys of the scene's stages that the run needs; an encoding is not needed any more once what it serves
    is done."""
    steps, missing = expected_steps(job), {step.stage for step in pending(job)}
    keys = {}
    for one in stages_of(job):
        readers = {reader.name for reader in stages_of(job) if one.name in reader.reads}
        if one.name in SCENE_STAGES and not (one.passing and not readers & missing):
            keys[one.name] = steps[one.name].key
    return keys
