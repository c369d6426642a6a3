"""What this process computes with."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator

import torch


def device() -> str:
    """This process's device. A worker sees one GPU only, see `flows/workers/`."""
    return "cuda" if torch.cuda.is_available() else "cpu"


def visible_gpus() -> list[str]:
    """The GPUs this process may use, as CUDA_VISIBLE_DEVICES names them."""
    given = os.environ.get("CUDA_VISIBLE_DEVICES")
    count = torch.cuda.device_count()
    return given.split(",")[:count] if given else [str(i) for i in range(count)]


def free_device_memory() -> None:
    """Give the memory that PyTorch keeps for later back to the GPU's other users."""
    if torch.cuda.is_available():
        torch.cuda.empty_cache()


@contextlib.contextmanager
def cpu_threads(count: int) -> Iterator[None]:
    """PyTorch with this many CPU threads: the same number in every process, as it may decide how sums are split."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
