"""Every call of a whole run to Dask fails once in turn, and a scheduler is killed: a sentence, and equal bits after."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import distributed
import pytest

import flows.cli
from flows.jobs.job import Job
from flows.jobs.request import make_request
from flows.workers import dask_executor
from tests.flows.conftest import ROOT, environment
from tests.flows.workers.dask_faults import LIMIT_S, Calls, limited
from tests.reliability.tiny import SETTINGS, SOURCE, digest, model, problems

#: Every so many-th call fails: every second one takes ten minutes of two cores, 1 is the whole loop and takes twenty.
EVERY = int(os.environ.get("CAT3D_DASK_EVERY", "2"))


@pytest.fixture(scope="module")
def command(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., tuple[Job, list[str]]]:
    """The job and the words of `cat3d run` of the tiny run into a folder, on a running cluster."""
    weights = model(tmp_path_factory.mktemp("model"))

    def make(out: Path, address: str) -> tuple[Job, list[str]]:
        settings = [s.replace("skip={", "skip={seen: false, detail: false, ") for s in SETTINGS]
        settings += [f"sample.checkpoint={weights}", "execution.executor=dask", f"execution.dask_address={address}"]
        words = ["cat3d", "run", SOURCE, "--views", "3", "--out", str(out)]
        given = {"downscale": None, "method": "auto", "preset": "fast", "seed": 0}
        [job] = make_request(SOURCE, out, "3", given, settings=settings).jobs()
        return job, [*words, *(word for setting in settings for word in ("--set", setting))]

    return make


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[[list[str]], tuple[int, str]]:
    """Run the words here, without the report, which asks nothing of a cluster: exit code and what was said last."""
    monkeypatch.setattr("flows.reporting.report.write_report", lambda out, **_: out / "report.html")

    def call(words: list[str]) -> tuple[int, str]:
        monkeypatch.setattr(sys, "argv", words)
        with limited(LIMIT_S), pytest.raises(SystemExit) as stopped:
            flows.cli.main()
        return int(stopped.value.code or 0), capsys.readouterr().err

    return call


def says_what_happened(code: int, said: str) -> bool:
    """One sentence and exit code 1, or nothing."""
    return not said if code == 0 else code == 1 and said.startswith("cat3d: ") and "Traceback" not in said


def settled(job: Job) -> list[str]:
    """What verification finds once the workers have ended what they were at when their client left: until then a file
    may be half written."""
    end = time.monotonic() + LIMIT_S
    while (found := problems(job)) and time.monotonic() < end:
        time.sleep(0.5)
    return found


@pytest.mark.slow
@pytest.mark.timeout(3000)
def test_every_call_of_a_run_to_dask_fails_once_in_turn(
    address: str, calls: Calls, command: Any, run: Any, tmp_path: Path
) -> None:
    job, words = command(tmp_path / "undisturbed", address)
    assert run(words) == (0, "")
    expected, done, ended = digest(job), Counter[str](), Counter[int]()
    assert problems(job) == []
    for name in dict.fromkeys(calls.counted):
        number, met = 1 - EVERY, True
        while met:
            number += EVERY
            job, words = command(tmp_path / f"{name}{number}", address)
            calls.fail((name, number))
            code, said = run(words)
            met = bool(calls.failed)
            told = f"{name}, call {number}, {calls.failed}: {code}, {said}"
            assert says_what_happened(code, said), told
            assert settled(job) == [], told
            calls.fail()
            assert run(words) == (0, ""), told
            assert digest(job) == expected, told
            done[name] += met
            ended[code] += met
    print(f"{done.total()} calls failed once, {ended[1]} of them ended the run: {dict(done)}")
    assert done.total() >= 42 // EVERY, "four of each of ten batches, and those of the executor"


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_scheduler_that_is_killed_ends_the_run_in_a_sentence(
    address: str, command: Any, run: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files = tmp_path / "scheduler.json"
    options = {"cwd": ROOT, "env": environment() | {"PYTHONPATH": str(ROOT)}, "stderr": subprocess.DEVNULL}
    python = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "0"]
    scheduler = subprocess.Popen([*python, "--no-dashboard", "--scheduler-file", str(files)], **options)
    started = [scheduler]
    try:
        while not files.exists():
            time.sleep(0.1)
        far = distributed.Client(scheduler_file=str(files), set_as_default=False)
        worker = [sys.executable, "-m", "distributed.cli.dask_worker", "--scheduler-file", str(files), "--nthreads",
                  "1", "--no-dashboard", "--no-nanny"]  # fmt: skip
        started.append(subprocess.Popen(worker, **options))
        far.wait_for_workers(1, timeout=LIMIT_S)
        job, words = command(tmp_path / "out", far.scheduler.address)
        far.close()
        submit, sent = dask_executor.PrefectDaskClient.submit, []

        def struck(self: Any, *arguments: Any, **options: Any) -> Any:
            sent.append(arguments)
            if len(sent) == 5:
                scheduler.kill()
            return submit(self, *arguments, **options)

        monkeypatch.setattr(dask_executor.PrefectDaskClient, "submit", struck)
        code, said = run(words)
    finally:
        for process in started:
            process.kill()
    print(said)
    assert code == 1
    assert says_what_happened(code, said), said
    assert problems(job) == []
    job, words = command(tmp_path / "out", address)
    assert run(words) == (0, "")
    other, words = command(tmp_path / "undisturbed", address)
    assert run(words) == (0, "")
    assert digest(job) == digest(other)
