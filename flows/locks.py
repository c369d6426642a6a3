"""One writer at a time: a lock file beside what is written. And which process that is, and whether it lives."""

from __future__ import annotations

import contextlib
import fcntl
import os
import platform
import time
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import psutil

from flows.errors import InputError, WorkerError

RETRY_S = 0.2


def this_process() -> str:
    """What a lock or claim says of its holder."""
    return f"process {os.getpid()} of {platform.node()}"


def lives(pid: int, since: float | None = None) -> bool:
    """Whether the process of this machine is there, and is no later one of the same number: it had begun by `since`
    (seconds of the epoch)."""
    try:
        began = psutil.Process(pid).create_time()
    except psutil.NoSuchProcess:
        return False
    return since is None or began <= since


@contextlib.contextmanager
def writing(store_path: Path, scene_id: str) -> Iterator[None]:
    """Be the only command that writes this store; a kill frees the lock. Raises InputError while another one writes."""
    store_path.parent.mkdir(parents=True, exist_ok=True)
    with open(store_path.with_name(f".{scene_id}.lock"), "a+") as file:
        if not _locked(file):
            raise InputError(
                f"Another cat3d command ({_holder(file)}) is writing {store_path}; "
                "wait for it, or choose another --out."
            )
        yield


@contextlib.contextmanager
def only_worker(path: Path, what: str, patience_s: float) -> Iterator[None]:
    """Be the only worker at one stage of one run; a kill frees the lock.

    It is held by another where the command that asked for the stage has ended and its worker has not, or where a worker
    that was given up lives on after all: this one waits for it. Raises WorkerError when that takes too long.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    deadline = time.monotonic() + patience_s
    with open(path, "a+") as file:
        while not _locked(file):
            if time.monotonic() > deadline:
                raise WorkerError(
                    f"{what} is still being done by another worker ({_holder(file)}), for which this one waited in "
                    f"vain ({patience_s:g} s); end that process and run the same command again."
                )
            time.sleep(RETRY_S)
        yield


def _locked(file: IO[str]) -> bool:
    """Take the lock, and write down who has it; False where another one does."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    file.truncate(0)
    file.write(this_process())
    file.flush()
    return True


def _holder(file: IO[str]) -> str:
    file.seek(0)
    return file.read().strip() or "unknown"
