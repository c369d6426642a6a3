"""What a piece of work really used: the device it ran on and the most memory it held, apart from all work before it."""

from __future__ import annotations

import contextlib
import re
import resource
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import torch

_PROCESS = Path("/proc/self")


@dataclass
class Usage:
    """device: "cpu", or the name of the accelerator that memory was allocated on. peak_memory_bytes: the most resident
    memory of one process, or the most memory of the accelerator where that is larger."""

    device: str = "cpu"
    peak_memory_bytes: int = 0

    def with_(self, other: Usage) -> Usage:
        """Of both, done in different processes."""
        device = self.device if other.device == "cpu" else other.device
        return Usage(device, max(self.peak_memory_bytes, other.peak_memory_bytes))


@contextlib.contextmanager
def measured() -> Iterator[Usage]:
    """Measure what is done inside; the yielded `Usage` is filled at the end, whether that is reached or not."""
    usage = Usage()
    with contextlib.suppress(OSError):
        (_PROCESS / "clear_refs").write_text("5")  # the kernel's peak of resident memory starts again from here
    before = _allocations()
    if before:
        torch.cuda.reset_peak_memory_stats()
    try:
        yield usage
    finally:
        usage.peak_memory_bytes = _peak_resident()
        if _allocations() > before:
            usage.device = torch.cuda.get_device_name()
            usage.peak_memory_bytes = max(usage.peak_memory_bytes, torch.cuda.max_memory_allocated())


def _allocations() -> int:
    """Allocations on the accelerator by this process so far."""
    return int(torch.cuda.memory_stats().get("allocation.all.allocated", 0)) if torch.cuda.is_initialized() else 0


def _peak_resident() -> int:
    """Bytes; of the whole process so far where the kernel does not say it of less."""
    with contextlib.suppress(OSError):
        found = re.search(r"^VmHWM:\s+(\d+) kB", (_PROCESS / "status").read_text(), re.MULTILINE)
        if found:
            return int(found[1]) * 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
