"""Runs the tests on each mutant: `make mutants`.

One pytest process imports and collects everything, once. A fork of it runs each test and notes which functions of
cat3d_core it enters, and for how long it runs. Then, for every mutant, a fork swaps the function's code and runs the
tests that enter the function: those of the same room first, the fastest first, up to the first that fails. Both go
into files of JSON lines; a run that was interrupted goes on where it stopped.

A mutant is caught where a test fails, or takes much longer than it did, or the process dies.
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import json
import os
import select
import signal
import sys
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from _pytest.runner import runtestprotocol

from infra.mutants.entered import Entered, measure
from infra.mutants.swap import Living, Unusable

TESTS = ("tests/core", "tests/stress")
#: The tests of faults and of the search itself say nothing of other functions.
NOT_THESE = ("tests/stress/test_mutations.py",)
TOO_LONG_S = 20.0  # tests that take longer alone are left out
PATIENCE_S, PATIENCE = 5.0, 4.0  # seconds of computing that a test may take, plus so many times what it took before
ASLEEP_S = 300.0  # on the clock, for a test that waits for something


class Runner:
    """The pytest plugin that does it all in place of the usual loop over tests."""

    def __init__(self, mutants: list[dict[str, Any]], results: Path, minutes: float, together: float) -> None:
        self.mutants, self.results, self.minutes, self.together = mutants, results, minutes, together

    def pytest_sessionstart(self) -> None:
        import hypothesis

        # The first failing example is enough.
        quick = [hypothesis.Phase.explicit, hypothesis.Phase.generate]
        hypothesis.settings.register_profile(
            "mutants", hypothesis.settings.get_profile("cat3d"), phases=quick, report_multiple_bugs=False
        )
        hypothesis.settings.load_profile("mutants")

    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        items[:] = [item for item in items if not item.nodeid.startswith(NOT_THESE)]

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        if session.testsfailed:
            raise session.Interrupted(f"{session.testsfailed} errors during collection")
        torch.set_num_threads(1)
        living = Living()
        gc.collect()
        gc.freeze()  # forks share what is there; also hides it from gc.get_objects
        items = {item.nodeid: item for item in session.items}
        entered = measure(list(session.items), self.results.with_suffix(".tests.jsonl"), fork)
        until = time.monotonic() + 60 * self.minutes
        with self.results.open("a") as file:
            for number, mutant in enumerate(self.mutants):
                if time.monotonic() > until:
                    print(f"\nStopped after {self.minutes:g} minutes with {len(self.mutants) - number} to go.")
                    break
                tests = [(items[name], seconds) for name, seconds in tests_for(mutant, entered, self.together)]
                row = {**mutant, **judge(mutant, tests, living)}
                file.write(json.dumps(row) + "\n")
                file.flush()
                print(f"{number + 1}/{len(self.mutants)} {row['file']}:{row['line']} {row['verdict']}", flush=True)
        return True


def tests_for(mutant: dict[str, Any], entered: dict[str, Entered], together: float) -> list[tuple[str, float]]:
    """Names and seconds of the tests that enter the mutant's function, in the order in which to run them: as many as
    take `together` seconds, and always one."""
    where = f"{mutant['file']}:{mutant['function']}"
    found = [(name, e.seconds) for name, e in entered.items() if where in e.functions and e.usable(TOO_LONG_S)]
    room = "tests/core/" + str(Path(mutant["file"]).relative_to("cat3d_core").parent).removeprefix(".")
    found.sort(key=lambda test: (not test[0].startswith(room), test[1]))
    chosen, total = [], 0.0
    for name, seconds in found:
        if not chosen or total + seconds <= together:
            chosen.append((name, seconds))
            total += seconds
    return chosen


def judge(mutant: dict[str, Any], tests: list[tuple[pytest.Item, float]], living: Living) -> dict[str, Any]:
    """What became of a mutant: its verdict, the test that caught it, how many tests it was given, the seconds."""
    started = time.monotonic()
    if not tests:
        return {"verdict": "untested", "test": None, "tests": 0, "seconds": 0.0}

    def work(say: Callable[[dict[str, Any]], None]) -> None:
        try:
            living.swap(mutant)
        except Unusable as fault:
            say({"unusable": str(fault)})
            return
        for i, (item, seconds) in enumerate(tests):
            say({"test": item.nodeid})
            signal.setitimer(signal.ITIMER_PROF, PATIENCE_S + PATIENCE * seconds)  # its signal ends the process
            following = tests[i + 1][0] if i + 1 < len(tests) else None
            if any(report.failed for report in runtestprotocol(item, log=False, nextitem=following)):
                say({"caught": item.nodeid})
                return
        say({"through": True})

    verdict, test = "died", None
    for message in fork(work):
        test = message.get("test", test)
        if "late" in message:
            verdict = "timeout"
        elif "caught" in message:
            verdict = "caught"
        elif "unusable" in message:
            verdict = message["unusable"]
        elif "through" in message:
            verdict, test = "survived", None
    return {"verdict": verdict, "test": test, "tests": len(tests), "seconds": round(time.monotonic() - started, 2)}


def fork(work: Callable[[Callable[[dict[str, Any]], None]], None]) -> list[dict[str, Any]]:
    """Run `work` in a fork of this process and return what it said, with {"late": True} at the end where its timer of
    computing time ended it, or where it said nothing for ASLEEP_S. Processes that it started are killed."""
    reading, writing = os.pipe()
    process = os.fork()
    if process == 0:
        os.setpgid(0, 0)
        os.close(reading)
        with contextlib.suppress(BaseException):
            work(lambda message: _write(writing, message))
        os._exit(0)
    os.close(writing)
    with contextlib.suppress(OSError):
        os.setpgid(process, process)
    messages: list[dict[str, Any]] = []
    rest, late = b"", False
    while True:
        if not select.select([reading], [], [], ASLEEP_S)[0]:
            late = True
            break
        chunk = os.read(reading, 65536)
        if not chunk:
            break
        *lines, rest = (rest + chunk).split(b"\n")
        messages += [json.loads(line) for line in lines]
    with contextlib.suppress(OSError):
        os.killpg(process, signal.SIGKILL)
    status = os.waitpid(process, 0)[1]
    os.close(reading)
    if late or (os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGPROF):
        messages.append({"late": True})
    return messages


def _write(pipe: int, message: dict[str, Any]) -> None:
    data = memoryview(json.dumps(message).encode() + b"\n")
    while data:
        data = data[os.write(pipe, data) :]


def pending(sample: Path, results: Path, again: set[str]) -> list[dict[str, Any]]:
    """Mutants of the sample without a verdict, and those whose last verdict is to be looked at again."""
    last: dict[str, str] = defaultdict(str)
    if results.exists():
        for line in results.read_text().splitlines():
            row = json.loads(line)
            last[row["id"]] = row["verdict"]
    mutants = [json.loads(line) for line in sample.read_text().splitlines()]
    return [m for m in mutants if (last[m["id"]] in again if again else not last[m["id"]])]


def main() -> int:
    """Judge what has no verdict yet."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sample", type=Path, required=True, help="what infra/mutants/generate.py wrote")
    parser.add_argument("--results", type=Path, required=True)
    parser.add_argument("--again", nargs="*", default=[], help="verdicts to judge again, such as survived untested")
    parser.add_argument("--minutes", type=float, default=1e9, help="stop after so many")
    parser.add_argument("--together", type=float, default=40.0, help="seconds of tests for one mutant, as measured")
    parser.add_argument("--tests", nargs="*", default=list(TESTS))
    options = parser.parse_args()
    mutants = pending(options.sample, options.results, set(options.again))
    print(f"{len(mutants)} mutants to judge")
    if not mutants:
        return 0
    folder = options.results.parent.resolve()
    arguments = [*options.tests, "-m", "not slow", "-q", "-s", "-p", "no:cacheprovider", f"--basetemp={folder}/files"]
    return pytest.main(arguments, plugins=[Runner(mutants, options.results, options.minutes, options.together)])


if __name__ == "__main__":
    sys.exit(main())
