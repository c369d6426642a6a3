"""How near a measured piece of work comes to what this machine can do at all: a roofline with two limits.

A row says its work (`Work`: floating-point operations, and the least bytes that must be read and written) and the time
it took. The limits are measured in the same process, on the same threads and by the same clock, when they are first
asked for:

- arithmetic: a large matrix product, in the number format of the work;
- memory: the better of a copy and a sum, of as many bytes as the work moves, so that work that fits a cache is held
  against that cache;
- files: one large file written and read again in the same folder, in the system's memory, as the benchmarks' are.

`share_of_limit` is the larger share of the first two (Williams et al. 2009): 1 would be a program that nothing can
speed up without doing less. Counted is what the method asks for, not what a program does: a program that computes twice
has half the share. Least bytes are less than what is moved, so a low share of memory may still be a full memory bus.
"""

from __future__ import annotations

import functools
import math
import os
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch

Clock = Literal["wall", "cpu"]
#: Processor time is of all threads; what other jobs take of the machine lengthens it less.
CLOCKS: dict[Clock, Callable[[], float]] = {"wall": time.perf_counter, "cpu": time.process_time}
REPEATS = 5
#: Of the matrices, and how often they are multiplied. The smaller take milliseconds, which a busy machine leaves alone.
SIDES = {"cpu": ((512, 40), (1024, REPEATS)), "cuda": ((4096, REPEATS), (8192, REPEATS))}
LEAST_BYTES, MOST_BYTES = 2**16, 2**28
FILE_BYTES, PIECE_BYTES, ROW_BYTES = 2**25, 2**20, 2**21


@dataclass(frozen=True)
class Work:
    """flops: additions and multiplications, each one. bytes: read and written, each at least once."""

    flops: float = 0.0
    bytes: float = 0.0

    def __add__(self, other: Work) -> Work:
        return Work(self.flops + other.flops, self.bytes + other.bytes)

    def __mul__(self, times: float) -> Work:
        return Work(self.flops * times, self.bytes * times)


def columns(
    work: Work, seconds: float, clock: Clock = "wall", dtype: torch.dtype = torch.float32, device: str = "cpu"
) -> dict[str, Any]:
    """`gflop_per_s`, `gb_per_s` (1e9 each), `share_of_limit`, and `bound_by`, the limit that is nearer. seconds: of the
    work, by the clock, on as many threads as torch has now."""
    shares = {
        "arithmetic": work.flops / seconds / peak_flops(dtype, device, torch.get_num_threads(), clock),
        "memory": work.bytes / seconds / peak_bytes(_rounded(work.bytes), device, torch.get_num_threads(), clock),
    }
    nearer = max(shares, key=lambda name: shares[name])
    return {
        "gflop_per_s": work.flops / seconds / 1e9, "gb_per_s": work.bytes / seconds / 1e9,
        "share_of_limit": shares[nearer], "bound_by": nearer,
    }  # fmt: skip


def file_columns(written: float, read: float, seconds: float, folder: Path, clock: Clock = "wall") -> dict[str, Any]:
    """The same for work on files in `folder`: bytes that go to files and come from them."""
    to, back = file_rates(folder, clock)
    share = (written / to + read / back) / seconds
    return {"gb_per_s": (written + read) / seconds / 1e9, "share_of_limit": share, "bound_by": "files"}


def _rounded(size: float) -> int:
    """The next power of two, within what is measured."""
    return int(min(MOST_BYTES, max(LEAST_BYTES, 2 ** math.ceil(math.log2(max(1.0, size))))))


def best_seconds(
    run: Callable[[], Any], clock: Clock = "wall", device: str = "cpu", times: int = 1, repeats: int = REPEATS
) -> float:
    """Seconds of one of `times` runs in a row, the best of `repeats` rows."""
    now, found = CLOCKS[clock], []
    for _ in range(repeats + 1):  # the first warms up
        started = now()
        for _ in range(times):
            run()
        if device == "cuda":
            torch.cuda.synchronize()
        found.append((now() - started) / times)
    return max(min(found), 1e-9)


@functools.cache
def peak_flops(dtype: torch.dtype, device: str, threads: int, clock: Clock) -> float:
    """Floating-point operations a second of a large matrix product, the best of two sizes."""
    best = 0.0
    for side, repeats in SIDES[device]:
        square = torch.ones((side, side), dtype=dtype, device=device)
        out = torch.empty_like(square)
        product = functools.partial(torch.mm, square, square, out=out)
        best = max(best, 2 * side**3 / best_seconds(product, clock, device, repeats=repeats))
    return best


@functools.cache
def peak_bytes(size: int, device: str, threads: int, clock: Clock) -> float:
    """Bytes a second of work that moves `size` bytes, which lie in a cache if they fit: the better of a copy (half of
    them read, half written) and a sum (all of them read)."""
    source = torch.ones(size // 4, device=device)
    half, target = source[: size // 8], torch.empty(size // 8, device=device)
    times = max(1, ROW_BYTES // size)
    # On a busy machine a row is often interrupted: the shorter it is, the more of them.
    many = max(REPEATS, min(8 * REPEATS, MOST_BYTES // (times * size)))
    copy, total = (best_seconds(run, clock, device, times, many) for run in (lambda: target.copy_(half), source.sum))
    return size / min(copy, total)


@functools.cache
def file_rates(folder: Path, clock: Clock) -> tuple[float, float]:
    """Bytes a second of one large file written into `folder`, and read from there as soon as it is written."""
    now, best = CLOCKS[clock], [math.inf, math.inf]
    piece, buffer = os.urandom(PIECE_BYTES), bytearray(PIECE_BYTES)
    with tempfile.TemporaryDirectory(prefix="cat3d-limit-", dir=folder) as inside:
        path = Path(inside) / "file"
        for _ in range(REPEATS):
            started = now()
            with open(path, "wb", buffering=0) as file:
                for _ in range(FILE_BYTES // PIECE_BYTES):
                    file.write(piece)
            middle = now()
            with open(path, "rb", buffering=0) as file:
                while file.readinto(buffer):
                    pass
            best = [min(best[0], middle - started), min(best[1], now() - middle)]
            path.unlink()
    return FILE_BYTES / max(best[0], 1e-9), FILE_BYTES / max(best[1], 1e-9)
