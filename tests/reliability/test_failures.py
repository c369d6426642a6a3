"""The n-th call to the system fails, the power fails after the n-th change: never silently wrong, and the next run
ends with the bits of an undisturbed one. `faults.c` stands between the process and the C library."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.flows.conftest import ROOT
from tests.reliability.faults import built, environment
from tests.reliability.tiny import model


def drive(folder: Path, task: str, *options: str) -> dict[str, Any]:
    """What the driver's task says of a tiny run in `folder`."""
    model(folder)
    done = subprocess.run(
        [sys.executable, "-m", "tests.reliability.driver", task, str(folder.resolve()), *options],
        cwd=ROOT, env=environment(built(folder)), capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-3000:]
    report: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    print(report)
    return report


@pytest.mark.slow
@pytest.mark.timeout(1400)
@pytest.mark.parametrize("every", [61])
def test_a_call_that_the_system_refuses_ends_in_a_sentence_and_the_next_run_is_whole(every: int, tmp_path: Path):
    report = drive(tmp_path, "refuse", str(every), "one")
    calls, refused, tolerated = map(sum, zip(*report["stages"].values()))
    assert calls > 1500, "every layer is seen"
    assert refused + tolerated >= calls // every
    assert not report["faults"], "\n\n".join(report["faults"])


@pytest.mark.slow
@pytest.mark.timeout(1400)
@pytest.mark.parametrize("every", [67])
def test_what_was_not_synced_when_the_power_failed_is_made_again(every: int, tmp_path: Path) -> None:
    report = drive(tmp_path, "lose", str(every))
    assert report["changes"] > 1000
    assert report["replayed"] == 3 * (report["changes"] // every)
    assert not report["faults"], "\n\n".join(report["faults"])
