"""The runner of mutants: a swapped function is what everybody calls, and no mutant runs for ever."""

from __future__ import annotations

import json
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from cat3d_core import view_selection
from infra.mutants.report import survivors, table
from infra.mutants.run import fork, pending
from infra.mutants.swap import ROOT, Living, Unusable

FILE = "cat3d_core/view_selection.py"


def mutant(old: str, new: str) -> dict[str, Any]:
    """A change of the one line of `evenly` that holds `old`."""
    lines = (ROOT / FILE).read_text().splitlines()
    (at,) = (i for i, line in enumerate(lines) if old in line and "most" in line)
    return {
        "file": FILE,
        "function": "evenly",
        "start": at + 1,
        "old": [lines[at]],
        "new": [lines[at].replace(old, new)],
    }


def test_the_living_function_is_swapped() -> None:
    held, sound = view_selection.evenly, view_selection.evenly.__code__
    try:
        Living().swap(mutant("(count - 1)", "(count + 1)"))
        assert held(10, 4) == [0, 4, 7, 11]
    finally:
        held.__code__ = sound
    assert held(10, 4) == [0, 3, 6, 9]


def test_what_changes_nothing_or_no_longer_fits_is_said() -> None:
    with pytest.raises(Unusable, match="same"):
        Living().swap(mutant("(count - 1)", "((count - 1))"))
    with pytest.raises(Unusable, match="stale"):
        Living().swap(mutant("(count - 1)", "1") | {"old": ["another line"]})


def test_a_fork_says_what_it_found_and_ends_in_time() -> None:
    def endless(say: Callable[[dict[str, Any]], None]) -> None:
        say({"test": "a"})
        signal.setitimer(signal.ITIMER_PROF, 0.2)
        while True:
            pass

    began = time.process_time()
    assert fork(endless) == [{"test": "a"}, {"late": True}]
    assert time.process_time() - began < 5
    assert fork(lambda say: say({"through": True})) == [{"through": True}]
    assert fork(lambda say: 1 / 0) == []  # a process that dies has caught its mutant


def test_a_run_goes_on_where_it_stopped_and_the_last_verdict_counts(tmp_path: Path) -> None:
    rows = [{"id": name, "file": FILE, "line": 1, "function": "evenly", "old": ["a"], "new": ["b"]} for name in "abc"]
    sample, results = tmp_path / "sample.jsonl", tmp_path / "results.jsonl"
    sample.write_text("".join(json.dumps(row) + "\n" for row in rows))
    assert len(pending(sample, results, set())) == 3
    first = {row["id"]: row | {"verdict": verdict, "tests": 2} for row, verdict in zip(rows, ("caught", "survived"))}
    last = first | {"b": first["b"] | {"verdict": "timeout"}}
    results.write_text("".join(json.dumps(row) + "\n" for row in first.values()))
    assert [row["id"] for row in pending(sample, results, set())] == ["c"]
    assert [row["id"] for row in pending(sample, results, {"survived"})] == ["b"]
    assert table(first, last)[-1] == "| all | 2 | 1 (50%) | 2 (100%) |"
    assert survivors(first.values())[1:] == ["  - a", "  + b"]
    assert not survivors(last.values())
