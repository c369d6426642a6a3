"""Which functions of cat3d_core each test enters, and how long it takes."""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import pytest
from _pytest.runner import runtestprotocol

from infra.mutants.swap import CORE, function_name


@dataclass(frozen=True)
class Entered:
    """One test: its seconds of computing with set-up, `FILE:FUNCTION` of what it enters, whether it holds on the sound
    code."""

    seconds: float
    functions: frozenset[str]
    holds: bool

    def usable(self, longest_s: float) -> bool:
        """Whether it is to be run on mutants."""
        return self.holds and self.seconds <= longest_s


class _Tracer:
    """A trace function that notes the code objects of cat3d_core once each, and follows no lines."""

    def __init__(self) -> None:
        self.seen: set[CodeType] = set()

    def __call__(self, frame: FrameType, event: str, argument: object) -> None:
        code = frame.f_code
        if code not in self.seen and code.co_filename.startswith(CORE):
            self.seen.add(code)


def measure(items: list[pytest.Item], path: Path, fork: Callable[..., list[dict[str, Any]]]) -> dict[str, Entered]:
    """What each test enters, measured for those that `path` does not name yet (remove it to measure all anew).

    All of them run in one fork, so that this process stays as it was after collecting."""
    known = _read(path)
    new = [item for item in items if item.nodeid not in known]

    def work(say: Callable[[dict[str, Any]], None]) -> None:
        with path.open("a") as file:
            for item in new:
                say({"test": item.nodeid})
                started = time.process_time()
                tracer = _Tracer()
                sys.settrace(tracer)
                threading.settrace(tracer)
                # As if it were the last: fixtures that tests share are made for each, and are part of what it enters.
                reports = runtestprotocol(item, log=False, nextitem=None)
                sys.settrace(None)
                seconds = time.process_time() - started
                row = {
                    "test": item.nodeid, "seconds": round(seconds, 3),
                    "holds": not any(report.failed for report in reports),
                    "functions": sorted({":".join(function_name(code)) for code in tracer.seen}),
                }  # fmt: skip
                file.write(json.dumps(row) + "\n")
                file.flush()

    if new:
        print(f"\nRunning {len(new)} tests once, to see what they enter")
        fork(work)
    known = _read(path)
    return {
        item.nodeid: Entered(row["seconds"], frozenset(row["functions"]), row["holds"])
        for item in items
        if (row := known.get(item.nodeid)) is not None
    }


def _read(path: Path) -> dict[str, dict[str, Any]]:
    if not path.exists():
        return {}
    return {row["test"]: row for row in map(json.loads, path.read_text().splitlines())}
