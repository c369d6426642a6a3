"""Damage by chance, the same for the same number: bytes that are flipped, cut, doubled and moved, numbers and words in
texts that become extreme ones. And what damaged input may do: end in a sentence, in time, in bounded memory."""

from __future__ import annotations

import contextlib
import math
import os
import random
import re
import resource
import time
import traceback
from collections.abc import Callable, Iterator

from flows.errors import describe

#: What replaces a number or a word of a text.
EXTREMES = [b"0", b"-1", b"1e999", b"NaN", b"null", b"[]", b"{}", b'""', b"true", b"4294967296", b"-0.0", b"1e-320",
            b"99999999999999999999", b"9007199254740993", b'"../../../etc/passwd"', b'"\\u0000"', b"[" * 20_000,
            b"\xff\xfe", b"\n", b" "]  # fmt: skip
#: And four bytes of anything else.
PATTERNS = [b"\0\0\0\0", b"\xff\xff\xff\xff", b"\xff\xff\xff\x7f", b"\0\0\0\x80", b"\x01\0\0\0", b"\0\0\x80\x7f"]
WORD = re.compile(rb"-?\d[\d.eE+-]*|\"[^\"\n]*\"|[A-Za-z_]+")
#: A single damaged input may take so long, and the memory of the process may grow by so much while it is read.
MOST = 2000
SECONDS, BYTES = 30.0, 3 * 2**30


def damaged(data: bytes, rng: random.Random) -> bytes:
    """`data` with one to four faults."""
    for _ in range(rng.choice((1, 1, 2, 4))):
        data = rng.choice(FAULTS)(data, rng)
    return data


def _flip(data: bytes, rng: random.Random) -> bytes:
    out = bytearray(data or b"\0")
    out[rng.randrange(len(out))] ^= 1 << rng.randrange(8)
    return bytes(out)


def _cut(data: bytes, rng: random.Random) -> bytes:
    return data[: rng.randrange(len(data) + 1)]


def _remove(data: bytes, rng: random.Random) -> bytes:
    start = rng.randrange(len(data) + 1)
    return data[:start] + data[start + rng.randrange(1, 40) :]


def _repeat(data: bytes, rng: random.Random) -> bytes:
    start = rng.randrange(len(data) + 1)
    part = data[start : start + rng.randrange(1, 200)]
    return data[:start] + part * rng.choice((2, 50)) + data[start:]


def _pattern(data: bytes, rng: random.Random) -> bytes:
    start = rng.randrange(len(data) + 1)
    return data[:start] + rng.choice(PATTERNS) + data[start + 4 :]


def _word(data: bytes, rng: random.Random) -> bytes:
    found = list(WORD.finditer(data[:100_000]))
    if not found:
        return _pattern(data, rng)
    word = rng.choice(found)
    return data[: word.start()] + rng.choice(EXTREMES) + data[word.end() :]


def _swap(data: bytes, rng: random.Random) -> bytes:
    lines = data.split(b"\n")
    a, b = rng.randrange(len(lines)), rng.randrange(len(lines))
    lines[a], lines[b] = lines[b], lines[a]
    return b"\n".join(lines)


FAULTS = (_flip, _flip, _cut, _remove, _repeat, _pattern, _pattern, _word, _word, _word, _swap)


def seconds(quick: float) -> float:
    """How long to go on: `quick`, or CAT3D_FUZZ_SECONDS."""
    return float(os.environ.get("CAT3D_FUZZ_SECONDS", quick))


def numbers(limit_s: float) -> Iterator[int]:
    """0, 1, ... until the time is over, at least twenty of them and at most MOST unless CAT3D_FUZZ_SECONDS asks for
    more: the same inputs on every machine that is quick enough. From CAT3D_FUZZ_FIRST on."""
    first = int(os.environ.get("CAT3D_FUZZ_FIRST", 0))
    most = math.inf if "CAT3D_FUZZ_SECONDS" in os.environ else first + MOST
    started, number = time.monotonic(), first
    while number < first + 20 or (number < most and time.monotonic() - started < limit_s):
        yield number
        number += 1


def refused(use: Callable[[], object]) -> str | None:
    """Use damaged input: the sentence it was refused with, or None where it was taken. Raises AssertionError for
    anything else: another error, more time, more memory."""
    started = time.process_time()
    with bounded():
        try:
            use()
            sentence = None
        except Exception as error:
            sentence = describe(error)
            if sentence is None:
                raise AssertionError("".join(traceback.format_exception(error))[-3000:]) from None
    assert time.process_time() - started < SECONDS, f"it took {time.process_time() - started:.0f} s"
    return sentence


@contextlib.contextmanager
def bounded() -> Iterator[None]:
    """Address space for BYTES more than there is; beyond, allocation fails."""
    with open("/proc/self/statm") as file:
        size = int(file.read().split()[0]) * resource.getpagesize()
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (size + BYTES, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
