"""Workers that are processes of this machine: one per GPU, or each with its share of the CPU's threads."""

from __future__ import annotations

import contextlib
import os
import selectors
import signal
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import BinaryIO, cast

from flows.jobs.device import main_memory, visible_gpus, worker_count
from flows.jobs.needs import Needs
from flows.workers.work import Answer, Batch
from schemas.execution import ExecutionConfig


class LocalExecutor:
    """Starts workers as they are needed, and new ones for those that die. Batches and answers are lines of JSON."""

    exclusive = True

    def __init__(self, settings: ExecutionConfig, log_folder: Path) -> None:
        self.gpus = visible_gpus()
        self.count = worker_count(settings)
        self.threads = settings.threads
        self.log_folder = log_folder
        self.running: dict[int, _Worker] = {}  # by place, 0 to count - 1
        memory = main_memory()
        self.memory_gb = None if memory is None else memory / 1e9
        self.selector = selectors.DefaultSelector()
        self.rung, self.bell = os.pipe()  # what `wake` writes to ends the selector's wait
        self.selector.register(self.rung, selectors.EVENT_READ, None)
        log_folder.mkdir(parents=True, exist_ok=True)

    def workers(self, needs: Needs) -> int:
        return self.count

    def room(self, needs: Needs, out: Counter[Needs]) -> int:
        """Places that are free, as long as memory is; one batch is always let in."""
        places = self.count - out.total()
        if self.memory_gb is None or not out:
            return places
        free = self.memory_gb - sum(other.memory_gb * count for other, count in out.items())
        return min(places, max(0, int(free / max(needs.memory_gb, 1e-3))))

    def wake(self) -> None:
        with contextlib.suppress(OSError):  # closed meanwhile
            os.write(self.bell, b"!")

    def submit(self, batch: Batch) -> None:
        idle = [w for w in self.running.values() if w.batch is None]
        worker = idle[0] if idle else self._start(next(p for p in range(self.count) if p not in self.running))
        worker.batch = batch.number
        with contextlib.suppress(BrokenPipeError):  # it has just died, which `answers` will see
            worker.stdin.write(batch.model_dump_json().encode() + b"\n")
            worker.stdin.flush()

    def answers(self, timeout_s: float) -> list[Answer]:
        out = []
        for ready, _ in self.selector.select(timeout_s):
            if ready.data is None:
                os.read(self.rung, 4096)
                continue
            worker: _Worker = ready.data
            line = worker.stdout.readline()
            if line.endswith(b"\n"):
                worker.batch = None
                out.append(Answer.model_validate_json(line))
                continue
            number, code = worker.batch, self._end(worker)
            if number is not None:
                out.append(Answer(number=number, died=_how(code) + f" (its log: {worker.log})"))
        return out

    def take_back(self, batch: Batch) -> list[int]:
        for worker in list(self.running.values()):
            if worker.batch == batch.number:
                self._end(worker)
        return []

    def close(self) -> None:
        for worker in list(self.running.values()):
            self._end(worker)
        self.selector.close()
        os.close(self.bell)
        os.close(self.rung)

    def _start(self, place: int) -> _Worker:
        environment = os.environ | {"OMP_NUM_THREADS": str(self.threads), "MKL_NUM_THREADS": str(self.threads)}
        if self.gpus:
            environment["CUDA_VISIBLE_DEVICES"] = self.gpus[place % len(self.gpus)]
        worker = _Worker(place, self.log_folder / f"worker-{place}.log", environment)
        self.running[place] = worker
        self.selector.register(worker.stdout, selectors.EVENT_READ, worker)
        return worker

    def _end(self, worker: _Worker) -> int:
        """Make sure the worker is gone; its exit code. It needs no warning: the store is whole at every moment."""
        self.selector.unregister(worker.stdout)
        del self.running[worker.place]
        worker.process.kill()
        code = worker.process.wait()
        for pipe in (worker.stdin, worker.stdout):
            with contextlib.suppress(OSError):
                pipe.close()
        return code


class _Worker:
    """A process that runs `flows.workers.worker`; `batch` is the number of the batch it has."""

    def __init__(self, place: int, log: Path, environment: dict[str, str]) -> None:
        self.place, self.log = place, log
        self.batch: int | None = None
        path = os.pathsep.join([p for p in sys.path if p])  # what this process can import, it can
        with open(log, "ab") as file:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "flows.workers.worker", str(os.getpid())],
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=file, env=environment | {"PYTHONPATH": path},
                process_group=0,  # Ctrl-C is for this process, which then ends its workers
            )  # fmt: skip
        self.stdin, self.stdout = cast(BinaryIO, self.process.stdin), cast(BinaryIO, self.process.stdout)


def _how(code: int) -> str:
    """How a process ended, to go after 'A worker'."""
    if code < 0:
        return f"was killed by {signal.Signals(-code).name}"
    return f"ended with exit code {code}"
