"""Killed, hanging and failing workers, a killed parent, a full disk, a read-only store: nothing is lost or doubled.

The faults are real: signals to real processes, a file system that is really full or read-only.
"""

from __future__ import annotations

import os
import random
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from flows.errors import WorkerError
from flows.jobs.job import Job
from flows.pipeline.keys import downstream
from schemas.documents import leftovers
from schemas.scene_store import SceneStore
from schemas.verify import verify
from tests.flows.conftest import ROOT, environment
from tests.flows.workers.scene import chunk_times, run_of, run_stages, workers_of


class Trouble(threading.Thread):
    """Sends `kind` to workers of this process once some view is done: to the first one found, or to all, again and
    again."""

    def __init__(self, job: Job, kind: signal.Signals, every: bool = False) -> None:
        super().__init__(daemon=True)
        self.job, self.kind, self.every = job, kind, every
        self.struck: set[int] = set()
        self.over = threading.Event()

    def run(self) -> None:
        while not self.over.wait(0.05):
            if self.every or any((run_of(self.job).generated.folder / "done_latent").glob("c.*")):
                for pid in workers_of(os.getpid()):
                    os.kill(pid, self.kind)
                    self.struck.add(pid)
                    if not self.every:
                        return

    def __enter__(self) -> Trouble:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.over.set()
        self.join()


def test_a_killed_workers_groups_are_taken_over(scene, expected) -> None:
    job = scene(workers=2, batch_seconds=100)
    with Trouble(job, signal.SIGKILL) as trouble:
        record = run_stages(job, "sample")["sample"]
    assert len(trouble.struck) == 1
    assert any("was killed by SIGKILL" in d.text and "handed to another" in d.text for d in record.decisions)
    assert np.array_equal(run_of(job).generated.read("latent"), expected["3"])
    assert leftovers(job.store_path) == []
    assert workers_of(os.getpid()) == []


@pytest.mark.slow
def test_a_hanging_worker_is_given_up_and_its_groups_are_taken_over(scene, expected) -> None:
    job = scene(workers=1, timeout_s=25)
    with Trouble(job, signal.SIGSTOP) as trouble:
        record = run_stages(job, "sample")["sample"]
    assert len(trouble.struck) == 1
    assert any("finished nothing for 25 s" in d.text for d in record.decisions)
    assert np.array_equal(run_of(job).generated.read("latent"), expected["3"])
    assert workers_of(os.getpid()) == []


def test_workers_that_always_die_end_in_a_sentence_that_names_the_work_and_the_logs(scene) -> None:
    job = scene(workers=1, attempts=2)
    with Trouble(job, signal.SIGKILL, every=True) as trouble, pytest.raises(WorkerError) as error:
        run_stages(job, "sample")
    assert len(trouble.struck) >= 2
    assert "2 workers were lost on item 0 of sample of procedural_dtu_3" in str(error.value)
    assert str(job.out / ".work") in str(error.value)
    assert SceneStore.open(job.store_path).record("sample", job.run) is None


def start(job: Job) -> subprocess.Popen[bytes]:
    """Sample and decode in a process of its own."""
    path = job.out / "job.json"
    path.write_text(job.model_dump_json())
    return subprocess.Popen(
        [sys.executable, "-m", "tests.flows.workers.scene", str(path)], cwd=ROOT, env=environment(),
        stderr=subprocess.PIPE, process_group=0,
    )  # fmt: skip


def wait_for(condition: Callable[[], object], timeout_s: float = 60) -> None:
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.02)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [signal.SIGINT, signal.SIGKILL])
def test_the_workers_end_with_their_parent_and_the_next_run_goes_on(scene, expected, kind) -> None:
    job = scene(workers=2, batch_seconds=0.1)  # a group a batch: some are left when the signal comes
    process = start(job)
    wait_for(lambda: len(chunk_times(job)) >= 10)
    process.send_signal(kind)
    process.communicate(timeout=30)
    wait_for(lambda parent=process.pid: not workers_of(parent), 5)
    before = chunk_times(job)
    assert 0 < len(before) < 24
    if kind == signal.SIGINT:
        assert leftovers(job.store_path) == []
    record = run_stages(job, "sample")["sample"]
    assert record.work["groups"] < 5
    after = chunk_times(job)
    assert {v: after[v] for v in before} == before
    assert np.array_equal(run_of(job).generated.read("latent"), expected["3"])


def mounted(script: str, *arguments: object) -> subprocess.CompletedProcess[str]:
    """Run a shell script in a mount name space of its own. Skips where the system does not allow that."""
    if subprocess.run(["unshare", "-rm", "true"], capture_output=True).returncode:
        pytest.skip("This system does not let the test mount file systems (unshare -rm).")
    return subprocess.run(
        ["unshare", "-rm", "sh", "-c", script, "sh", *map(str, arguments)], cwd=ROOT, env=environment(),
        capture_output=True, text=True, timeout=200,
    )  # fmt: skip


def test_a_full_disk_ends_in_a_sentence_and_what_was_done_stays(scene, expected, tmp_path: Path) -> None:
    job = scene(workers=1)
    (job.out / "job.json").write_text(job.model_dump_json())
    kept = tmp_path / "kept"
    # A file system over the output folder, filled up so that some of the views still find room.
    script = """
        cp -r "$1" "$2.copy" && mount -t tmpfs -o size=8m tmpfs "$1" && cp -r "$2.copy/." "$1" &&
        head -c "$(($(df --output=avail -k "$1" | tail -1) - 140))k" /dev/zero > "$1/filler" &&
        "$3" -m tests.flows.workers.scene "$1/job.json"; code=$?
        cp -r "$1" "$2"; exit $code"""
    done = mounted(script, job.out, kept, sys.executable)
    assert done.returncode == 1
    assert "No space left on device" in done.stderr
    assert "What was stored before is still good" in done.stderr or "Free space" in done.stderr
    shutil.rmtree(job.out)
    kept.rename(job.out)
    before = chunk_times(job)
    run_stages(job, "sample")
    after = chunk_times(job)
    assert 0 < len(before) < 24
    assert {v: after[v] for v in before} == before
    assert np.array_equal(run_of(job).generated.read("latent"), expected["3"])


def test_a_read_only_store_ends_in_a_sentence(scene) -> None:
    job = scene(workers=1)
    (job.out / "job.json").write_text(job.model_dump_json())
    script = 'mount --bind "$1" "$1" && mount -o remount,ro,bind "$1" && "$2" -m tests.flows.workers.scene "$3"'
    done = mounted(script, job.store_path, sys.executable, job.out / "job.json")
    assert done.returncode == 1
    assert "Read-only file system" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.slow
@pytest.mark.timeout(1500)
def test_thirty_kills_of_workers_and_parents_at_random_moments(scene, expected) -> None:
    """After every kill, what was complete is untouched; at the end everything equals the uninterrupted run."""
    job = scene(workers=2, attempts=1000)
    rng = random.Random(0)
    kills = {"worker": 0, "parent": 0}
    seen: dict[int, tuple[int, int]] = {}
    process = start(job)
    while sum(kills.values()) < 30:
        if rng.random() < 0.8:  # else while it starts
            wait_for(lambda p=process: workers_of(p.pid) or p.poll() is not None)
        time.sleep(rng.uniform(0, 4))
        if process.poll() is not None:  # it finished in between: take some of the result away again
            folder = run_of(job).generated.folder
            for view in rng.sample(range(24), 12):
                (folder / "done_latent" / f"c.{view}.0").unlink(missing_ok=True)
                seen.pop(view, None)
            SceneStore.open(job.store_path, "r+").invalidate(downstream("sample"), job.run)
            process = start(job)
            continue
        workers = workers_of(process.pid)
        if workers and rng.random() < 0.6:
            os.kill(rng.choice(workers), signal.SIGKILL)
            kills["worker"] += 1
        else:
            process.kill()
            process.communicate(timeout=30)
            wait_for(lambda parent=process.pid: not workers_of(parent), 5)
            kills["parent"] += 1
            assert [p for p in verify(SceneStore.open(job.store_path)) if p.kind in ("corrupted", "missing")] == []
            process = start(job)
        now = chunk_times(job)
        assert {view: now.get(view) for view in seen} == seen, "a complete view was sampled again"
        seen = now
    _, errors = process.communicate(timeout=300)
    assert process.returncode == 0, errors.decode()
    now = chunk_times(job)
    assert {view: now[view] for view in seen} == seen
    assert min(kills.values()) >= 5
    assert np.array_equal(run_of(job).generated.read("latent"), expected["3"])
    assert SceneStore.open(job.store_path).record("decode", job.run) is not None
    assert leftovers(job.store_path) == []
