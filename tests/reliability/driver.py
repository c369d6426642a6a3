"""A process in which calls can be refused (`faults.environment`): `python -m tests.reliability.driver TASK FOLDER ...`.

Each task prints one JSON document; what it means is said by the test that starts it.
"""

from __future__ import annotations

import errno
import json
import shutil
import sys
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

from flows.errors import describe
from tests.reliability.faults import Disk, Faults, events
from tests.reliability.tiny import REPORT, advance, digest, problems, stages, tiny_job

#: Every place is refused with one of these, one after the other; `all_errors` takes each of them at each place.
ERRORS = (errno.ENOSPC, errno.EIO, errno.EACCES, errno.EINTR)


def refuse_every_call(folder: Path, every: int, all_errors: bool) -> dict[str, Any]:
    """Each stage of the tiny run again and again, each time with another call refused: a sentence, a store without
    damage, and the same bits when it is run again.

    every: take each so many-th call. Returns {"stages": {name: [calls, refused, tolerated]}, "faults": [sentences]}.
    """
    model, before, out = folder / "tiny.safetensors", folder / "before", folder / "out"
    faults = Faults(out)
    job = tiny_job(out, model)
    report: dict[str, Any] = {"stages": {}, "faults": []}
    for number, stage in enumerate([*stages(job), REPORT]):
        shutil.copytree(out, before) if out.exists() else before.mkdir()
        faults.refuse(0)
        advance(job, stage)
        calls, expected = faults.counted, digest(job)
        counts = [calls, 0, 0]
        for call in range(1 + number % every, calls + 1, every):
            chosen = ERRORS if all_errors else (ERRORS[(call // every + number) % len(ERRORS)],)
            for error in chosen:
                _restore(before, out)
                faults.refuse(call, error)
                raised = _sentence(lambda: advance(job, stage))  # noqa: B023
                told = f"{stage}, call {call} ({errno.errorcode[error]}, {faults.refused})"
                faults.refuse(0)
                counts[1 if raised else 2] += 1
                if raised and raised[0] is None:
                    report["faults"].append(f"{told}: no sentence, but {raised[1]}")
                for problem in problems(job):
                    report["faults"].append(f"{told}: {problem}")
                again = _sentence(lambda: advance(job, stage))  # noqa: B023
                if again:
                    report["faults"].append(f"{told}: the next run failed too: {again[1]}")
                elif digest(job) != expected:
                    report["faults"].append(f"{told}: the next run ended with other results")
        report["stages"][stage] = counts
        _restore(before, out)
        advance(job, stage)
        shutil.rmtree(before)
    return report


def _restore(before: Path, out: Path) -> None:
    shutil.rmtree(out, ignore_errors=True)
    if any(before.iterdir()):
        shutil.copytree(before, out)


def _sentence(call: Callable[[], None]) -> tuple[str | None, str] | None:
    """What a user would read of the error that the call ended with, or None for a traceback, and the error in full;
    nothing where there was none."""
    try:
        call()
    except Exception as error:
        return describe(error), "".join(traceback.format_exception(error))[-1500:]
    return None


def lose_writes(folder: Path, every: int) -> dict[str, Any]:
    """The power fails after each change of the file system: what was not synced is lost in one of three ways, and the
    next run must end with the same bits.

    every: take each so many-th change. Returns {"changes": int, "replayed": int, "faults": [sentence, ...]}.
    """
    out = folder / "out"
    job = tiny_job(out, folder / "tiny.safetensors")
    faults = Faults(out)
    disk, report = Disk(out), {"changes": 0, "replayed": 0, "faults": []}
    for stage in stages(job):
        faults.record(folder / "events")
        advance(job, stage)
        faults.stop()
        expected, kept = digest(job), folder / "kept"
        out.rename(kept)
        for event in events(folder / "events"):
            disk.apply(event)
            report["changes"] += 1
            if report["changes"] % every:
                continue
            for loss in Disk.LOSSES:
                shutil.rmtree(out, ignore_errors=True)
                disk.fail(loss)
                report["replayed"] += 1
                told = f"{stage}, change {report['changes']} ({event.kind} {event.path}), {loss}"
                raised = _sentence(lambda: advance(job, stage))  # noqa: B023
                if raised:
                    report["faults"].append(f"{told}: the next run failed: {raised[1]}")
                elif digest(job) != expected:
                    report["faults"].append(f"{told}: the next run ended with other results")
                elif found := problems(job):
                    report["faults"].append(f"{told}: {found[0]}")
        shutil.rmtree(out, ignore_errors=True)
        kept.rename(out)
    return report


if __name__ == "__main__":
    task, place, *options = sys.argv[1:]
    if task == "refuse":
        document = refuse_every_call(Path(place), int(options[0]), options[1] == "all")
    else:
        document = lose_writes(Path(place), int(options[0]))
    print("\n" + json.dumps(document))
