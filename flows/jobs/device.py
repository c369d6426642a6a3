"""What this process computes with."""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Iterator

import torch

from flows.errors import InputError
from schemas.execution import ExecutionConfig

#: What `cpu_threads` has set: number of the block -> threads; 0: what was before the first block.
_COUNTS: dict[int, int] = {}
_LOCK = threading.Lock()


def device() -> str:
    """This process's device: a CUDA GPU, Apple's GPU ("mps") or the CPU; CAT3D_DEVICE names another choice. A worker
    sees one GPU only, see `flows/workers/`."""
    asked = os.environ.get("CAT3D_DEVICE")
    there = {"cuda": torch.cuda.is_available(), "mps": torch.backends.mps.is_available(), "cpu": True}
    if asked is None:
        return next(name for name, is_there in there.items() if is_there)
    if not there.get(asked, False):
        usable = ", ".join(name for name, is_there in there.items() if is_there)
        raise InputError(f"CAT3D_DEVICE is {asked!r}, which this machine doesn't have; it has {usable}.")
    return asked


def exact_device() -> str:
    """The same for what computes in float64, which Apple's GPUs don't: there it is the CPU."""
    return "cpu" if device() == "mps" else device()


def cpu_count() -> int:
    """CPU cores that this process may use (macOS and Windows tell only of all)."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def available_memory() -> int | None:
    """Bytes that are free on this process's device; None where the system doesn't say."""
    where = device()
    if where == "cuda":
        return int(torch.cuda.mem_get_info()[0])
    if where == "mps":
        return int(torch.mps.recommended_max_memory()) - int(torch.mps.driver_allocated_memory())
    with contextlib.suppress(OSError, ValueError, StopIteration), open("/proc/meminfo") as file:
        return 1024 * next(int(line.split()[1]) for line in file if line.startswith("MemAvailable:"))
    with contextlib.suppress(AttributeError, OSError, ValueError):
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_AVPHYS_PAGES")
    return None


def total_memory() -> int | None:
    """Bytes that this process's device has; None where the system doesn't say."""
    where = device()
    if where == "cuda":
        return int(torch.cuda.get_device_properties(0).total_memory)
    if where == "mps":
        return int(torch.mps.recommended_max_memory())
    return main_memory()


def main_memory() -> int | None:
    """Bytes of the machine's memory, or of its container's or SLURM job's share; None where the system doesn't say."""
    found = []
    with contextlib.suppress(AttributeError, OSError, ValueError):
        found.append(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    for limit in ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes"):
        with contextlib.suppress(OSError, ValueError), open(limit) as file:
            found.append(int(file.read()))  # "max", where there is no limit, is no number
    return min(found, default=None)


def visible_gpus() -> list[str]:
    """The GPUs this process may use, as CUDA_VISIBLE_DEVICES names them."""
    given = os.environ.get("CUDA_VISIBLE_DEVICES")
    count = torch.cuda.device_count()
    return given.split(",")[:count] if given else [str(i) for i in range(count)]


def worker_count(settings: ExecutionConfig) -> int:
    """How many workers this machine gets: as set, else one per GPU, else one per share of the CPU's threads."""
    return settings.workers or len(visible_gpus()) or max(1, cpu_count() // settings.threads)


def free_device_memory() -> None:
    """Give the memory that PyTorch keeps for later back to the GPU's other users."""
    if torch.cuda.is_available():
        torch.cuda.empty_cache()
    elif torch.backends.mps.is_available():
        torch.mps.empty_cache()


@contextlib.contextmanager
def cpu_threads(count: int) -> Iterator[None]:
    """PyTorch with this many CPU threads: the same number in every process, as it may decide how sums are split.

    The number is the whole process's. Blocks may lie in each other or, where a Dask worker has several threads, end in
    any order: the youngest one left decides, and after the last there is what was before the first."""
    with _LOCK:
        if not _COUNTS:
            _COUNTS[0] = torch.get_num_threads()
        mine = max(_COUNTS) + 1
        _COUNTS[mine] = count
        torch.set_num_threads(count)
    try:
        yield
    finally:
        with _LOCK:
            del _COUNTS[mine]
            torch.set_num_threads(_COUNTS[max(_COUNTS)])
            if len(_COUNTS) == 1:
                _COUNTS.clear()
