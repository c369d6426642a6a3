"""Several processes on one store, and processes that are killed."""

from __future__ import annotations

import multiprocessing as mp
import os
import random
import signal
import time
from pathlib import Path

import numpy as np

from schemas.errors import StoreError
from schemas.scene_store import SceneStore
from schemas.verify import verify

VIEWS, SHAPE = 60, (4, 16, 16)
# Children come from a clean server process: forking this one would copy whatever threads other tests have started.
CONTEXT = mp.get_context("forkserver")
CONTEXT.set_forkserver_preload(["schemas.scene_store", "schemas.verify"])


def latent(view: int) -> np.ndarray:
    return np.random.default_rng(view).normal(size=(1, *SHAPE)).astype(np.float16)


def key(view: int) -> str:
    return f"{view + 1:064x}"


def write_missing(path: str, views: range) -> None:
    """What a worker does: make each of its views that isn't done, data first."""
    generated = SceneStore.open(path, "r+").run("v3").generated
    done = generated.done("done_latent", [key(v) for v in range(VIEWS)], ["latent"])
    for view in views:
        if not done[view]:
            generated.write_views("latent", latent(view), [view])
            generated.mark_done("done_latent", [key(view)], [view])


def make_run(path: str, name: str) -> None:
    for i in range(20):
        run = SceneStore.open(path, "r+").run(f"run{i}", create=True)
        run.renders(f"kind-{name}").set_attrs(maker=name)


def _store(tmp_path: Path) -> SceneStore:
    store = SceneStore.create(tmp_path / "scene.zarr", "fox", "x", {})
    generated = store.run("v3", create=True).generated
    generated.create_array("latent", (VIEWS, *SHAPE))
    generated.create_array("done_latent", (VIEWS, 32))
    return store


def _check(store: SceneStore) -> int:
    """Every view marked as done is there and right; returns how many are."""
    assert [p for p in verify(SceneStore.open(store.root)) if p.kind != "orphan"] == []
    generated = store.run("v3").generated
    done = generated.done("done_latent", [key(v) for v in range(VIEWS)])
    for view in np.flatnonzero(done):
        assert np.array_equal(generated.read("latent", [view]), latent(int(view)))
    return int(done.sum())


def test_two_writers_of_different_views_and_a_reader(tmp_path: Path) -> None:
    store = _store(tmp_path)
    writers = [
        CONTEXT.Process(target=write_missing, args=(str(store.root), range(start, VIEWS, 2))) for start in (0, 1)
    ]
    for writer in writers:
        writer.start()
    counts = []
    while any(writer.is_alive() for writer in writers):
        counts.append(_check(store))
    assert [writer.exitcode for writer in writers] == [0, 0]
    assert counts == sorted(counts)
    assert _check(store) == VIEWS


def test_kill_9_at_random_moments_and_finish_later(tmp_path: Path) -> None:
    store = _store(tmp_path)
    rng = random.Random(0)
    count = 0
    for _ in range(6):
        writer = CONTEXT.Process(target=write_missing, args=(str(store.root), range(VIEWS)))
        writer.start()
        while writer.is_alive() and _done_files(store) < min(VIEWS, count + 6):
            time.sleep(0.002)
        time.sleep(rng.random() * 0.01)
        assert writer.pid is not None
        os.kill(writer.pid, signal.SIGKILL)
        writer.join()
        before, count = count, _check(store)
        assert count >= before
    assert count > 0
    store.sweep()
    write_missing(str(store.root), range(VIEWS))
    assert _check(store) == VIEWS
    assert list(verify(store)) == []


def test_runs_made_by_two_processes_at_once_are_whole(tmp_path: Path) -> None:
    store = SceneStore.create(tmp_path / "scene.zarr", "fox", "x", {})
    makers = [CONTEXT.Process(target=make_run, args=(str(store.root), name)) for name in ("a", "b")]
    for maker in makers:
        maker.start()
    for maker in makers:
        maker.join()
    assert [maker.exitcode for maker in makers] == [0, 0]
    assert len(store.runs()) == 20
    for name in store.runs():
        run = store.run(name)
        assert run.section("renders").names() == ["kind-a", "kind-b"]
        assert [run.renders(f"kind-{x}").attrs["maker"] for x in "ab"] == ["a", "b"]
    assert list(verify(store)) == []


def test_creating_a_store_is_all_or_nothing(tmp_path: Path) -> None:
    made = 0
    for i in range(4):
        path = tmp_path / f"{i}.zarr"
        maker = CONTEXT.Process(target=SceneStore.create, args=(path, "fox", "x", {}))
        maker.start()
        deadline = time.monotonic() + 20
        while maker.is_alive() and not list(tmp_path.glob(f"*{i}.zarr*")) and time.monotonic() < deadline:
            time.sleep(0.0005)
        os.kill(maker.pid or 0, signal.SIGKILL)
        maker.join()
        try:
            SceneStore.open(path)
            made += 1
        except StoreError as error:
            assert "does not exist" in str(error)  # noqa: PT017
            SceneStore.create(path, "fox", "x", {})
    assert made < 5


def _done_files(store: SceneStore) -> int:
    return len(list((store.root / "runs/v3/generated/done_latent").glob("c.*.0")))
