"""All stages of all runs on one set of workers: equal results whoever does them, and lost workers' stages go on."""

from __future__ import annotations

import dataclasses
import os
import signal
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flows.errors import WorkerError
from flows.jobs.job import Job
from flows.jobs.metric_table import metric_table
from flows.locks import only_worker
from flows.pipeline.costs import Costs, Outlook
from flows.pipeline.keys import pending
from flows.pipeline.scene import scene_flow
from flows.pipeline.side_by_side import shared_keys
from flows.pipeline.sweep import run_sweep, sweep_jobs
from flows.stages import STAGES
from flows.workers.pulse import Pulse, read_pulse
from schemas.scene_store import SceneStore
from schemas.tables import TIMINGS, read_rows
from schemas.verify import verify
from tests.flows.commands.test_reprocess import write_photos
from tests.flows.pipeline.test_sweep import TRAINER, sweep_of
from tests.flows.workers.scene import random_model, workers_of

SOURCE = "procedural:llff/2?views=9&width=24&height=20"


def metrics_of(out: Path) -> list[dict[str, Any]]:
    return read_rows(out / "metrics", metric_table()).to_pylist()


def stages_of_timings(out: Path) -> list[tuple[str, str]]:
    rows = read_rows(out / "timings", TIMINGS).to_pylist()
    return sorted(
        (row["run"] if row["stage"] not in ("ingest", "poses", "encode") else "", row["stage"]) for row in rows
    )


def swept(out: Path, *sources: str, methods: dict[str, Any], **execution: Any) -> list[dict[str, Any]]:
    """The metric table of a sweep that is done in this way."""
    config = sweep_of(*sources, methods=methods, base={"execution": execution})
    assert run_sweep(config, out) == []
    return metrics_of(out)


def test_runs_of_a_scene_run_side_by_side_and_give_the_table_of_one_after_the_other(
    tmp_path: Path, prefect_url: str, capsys: pytest.CaptureFixture[str]
) -> None:
    methods = {"zipnerf": {"method": "zipnerf"}, "slower": {"reconstruct": {"overrides": {"iterations": 12}}}}
    one = swept(tmp_path / "one", SOURCE, methods=methods, workers=1)
    two = swept(tmp_path / "two", SOURCE, methods=methods, workers=2)
    assert one == two
    assert len(one) == 2 * 2, "methods, held-out views"
    assert stages_of_timings(tmp_path / "one") == stages_of_timings(tmp_path / "two"), "nothing was done twice"
    assert list(verify(SceneStore.open(tmp_path / "two" / "procedural_llff_2.zarr"))) == []
    assert workers_of(os.getpid()) == []
    assert "No views were generated" in capsys.readouterr().out, "what workers decide is said by the command"


@pytest.mark.slow
def test_a_sweep_gives_one_table_with_one_and_two_processes_and_on_dask(tmp_path: Path, prefect_url: str) -> None:
    model = random_model(tmp_path / "tiny.safetensors")
    generated = {"method": "cat3d", "plan": {"views": 8}, "skip": {"covered_path": False},
                 "sample": {"checkpoint": str(model), "steps": 2}}  # fmt: skip
    methods, sources = {"zipnerf": {"method": "zipnerf"}, "cat3d": generated}, (SOURCE, SOURCE.replace("llff", "dtu"))
    ways = {"local1": {"workers": 1}, "local2": {"workers": 2}, "dask2": {"executor": "dask", "workers": 2}}
    tables = {name: swept(tmp_path / name, *sources, methods=methods, **way) for name, way in ways.items()}
    assert len(tables["local1"]) == 2 * 2 * 2, "scenes, methods, held-out views"
    assert tables["local1"] == tables["local2"] == tables["dask2"]
    stages = [stages_of_timings(tmp_path / name) for name in ways]
    assert stages[0] == stages[1] == stages[2]


@pytest.mark.slow
def test_a_lost_workers_reconstruction_goes_on_from_its_last_state(tmp_path: Path, prefect_url: str) -> None:
    """The worker is killed once it has saved a state; the other one takes the stage over, with an equal field."""
    long = {"reconstruct": {"overrides": TRAINER | {"iterations": 2000}}, "skip": {"plateau": False}}
    out, killed = tmp_path / "out", list[int]()

    def strike() -> None:
        while not list((out / ".work").glob("*.safetensors")):
            time.sleep(0.05)
        holder = next((out / ".work").glob("*long-reconstruct.lock")).read_text().split()[1]
        os.kill(int(holder), signal.SIGKILL)
        killed.append(int(holder))

    threading.Thread(target=strike, daemon=True).start()
    methods = {"long": long, "short": {"method": "zipnerf"}}
    struck = swept(out, SOURCE, methods=methods, workers=2, checkpoint_s=0.5)
    assert killed
    record = SceneStore.open(out / "procedural_llff_2.zarr").record("reconstruct", "v3-long")
    assert record is not None
    assert any(d.text.startswith("Went on from the checkpoint at iteration") for d in record.decisions)
    assert struck == swept(tmp_path / "whole", SOURCE, methods=methods, workers=1)


def test_a_failure_on_a_worker_ends_its_own_scene_alone_with_its_sentence(tmp_path: Path, prefect_url: str) -> None:
    for name in ("good", "broken"):
        write_photos(tmp_path / "data" / name)
    photo = sorted((tmp_path / "data" / "broken").rglob("*.png"))[0]
    photo.write_bytes(photo.read_bytes()[:200])
    config = sweep_of(f"{tmp_path}/data/*", base={"execution": {"workers": 2}})
    [problem] = run_sweep(config, tmp_path / "out")
    assert problem.startswith("broken v3-zipnerf: ")
    assert photo.name in problem
    assert {row["scene_id"] for row in metrics_of(tmp_path / "out")} == {"good"}


def jobs_of(out: Path, source: str = SOURCE, **changes: Any) -> list[Job]:
    return sweep_jobs(sweep_of(source, **changes), out)[0][0]


@pytest.mark.slow
def test_runs_that_want_other_photos_of_a_scene_come_after_one_another(tmp_path: Path, prefect_url: str) -> None:
    methods = {"whole": {}, "half": {"ingest": {"downscale": 2}}, "again": {}}
    source = "procedural:llff/2?views=9&width=48&height=40"
    jobs = jobs_of(tmp_path, source, methods=methods, base={"execution": {"workers": 2}})
    keys = [shared_keys(job) for job in jobs]
    assert keys[0] == keys[2] != keys[1]
    assert len(scene_flow("s", jobs)) == 2 * 2 + 3 * 3, "the photos and cameras of two waves, and the stages of runs"
    assert len({record.key for record in scene_flow("s", jobs[1:2])}) <= 5
    store = SceneStore.open(jobs[0].store_path)
    assert [store.run(job.run).renders("test").read("image").shape[1:3] for job in jobs] == [
        (40, 48),
        (20, 24),
        (40, 48),
    ]


def test_runs_of_all_seeds_share_given_cameras_and_are_done_then(
    tmp_path: Path, prefect_url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = sweep_of(SOURCE, seeds=[0, 1], base={"execution": {"workers": 1}})
    with monkeypatch.context() as patch:  # as before, when the cameras' key had the seed in it
        before = (dataclasses.replace(s, seedless=lambda _: False) for s in STAGES)
        patch.setattr("flows.pipeline.keys.STAGES", tuple(before))
        assert run_sweep(config, tmp_path) == []
    [jobs], _ = sweep_jobs(config, tmp_path)
    assert shared_keys(jobs[0]) == shared_keys(jobs[1])
    assert [step.stage for job in jobs for step in pending(job) if step.stage != "poses"] == [], "older results stay"
    assert run_sweep(config, tmp_path) == []
    executed = stages_of_timings(tmp_path)
    assert run_sweep(config, tmp_path) == []
    assert stages_of_timings(tmp_path) == executed
    assert [pending(job) for job in jobs] == [[], []]


def test_the_longest_run_comes_first_and_the_time_left_is_that_of_the_longest_or_of_all(tmp_path: Path) -> None:
    jobs = jobs_of(tmp_path, methods={"a": {}, "b": {}})
    costs = Costs(tmp_path)
    outlook = Outlook(jobs, [pending(job) for job in jobs], costs)
    assert outlook.steps_left() == 2 + 2 * 3, "photos and cameras are the scene's"
    assert outlook.seconds_left(2) is None, "nothing was timed yet"
    for stage, seconds in {"ingest": 1.0, "poses": 1.0, "reconstruct": 10.0, "render": 2.0, "evaluate": 1.0}.items():
        costs.learn("other", "v3-a", "a", stage, seconds)
        costs.learn("other", "v3-b", "b", stage, seconds * 2)
    assert costs.seconds(jobs[0], "reconstruct") == 10
    assert outlook.seconds_of(jobs[1]) > outlook.seconds_of(jobs[0])
    assert outlook.seconds_left(1) == pytest.approx(13 + 26 + 4)
    assert outlook.seconds_left(100) == pytest.approx(30)
    outlook.done(jobs[0], "ingest", 1.0)
    assert outlook.steps_left() == 1 + 2 * 3
    outlook.over(jobs[1])
    assert outlook.seconds_of(jobs[1]) == 0


def test_a_stage_has_one_worker_at_a_time_and_waits_for_one_that_lives_on(tmp_path: Path) -> None:
    path = tmp_path / "stage.lock"
    with only_worker(path, "render of s r", 1):
        refused = pytest.raises(WorkerError, match=rf"render of s r is still being done .*process {os.getpid()} of")
        with refused, only_worker(path, "render of s r", 0.3):
            pass
        entered = threading.Event()
        other = threading.Thread(target=lambda: _enter(path, entered))
        other.start()
        assert not entered.wait(0.3)
    assert entered.wait(5)
    other.join()


def _enter(path: Path, entered: threading.Event) -> None:
    with only_worker(path, "the other", 5):
        entered.set()


def test_a_worker_shows_that_it_lives_and_how_far_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from flows.progress import meter
    from flows.workers import pulse

    monkeypatch.setattr(pulse, "BEAT_S", 0.02)
    path = tmp_path / "stage.pulse"
    with meter("work", 5) as progress, Pulse(path):
        progress.update(3, "18.5 dB")
        deadline, first = time.monotonic() + 5, None
        while time.monotonic() < deadline and (first is None or (now := read_pulse(path)) == first):
            first = first or read_pulse(path)
        assert (now.done, now.total, now.note) == (3, 5, "18.5 dB")
    assert read_pulse(path) is None
    path.write_text("{")
    assert read_pulse(path) is None


def test_workers_are_shared_by_what_they_have() -> None:
    from collections import Counter

    from flows.jobs.needs import Needs
    from flows.workers.local import LocalExecutor
    from schemas.execution import ExecutionConfig

    small, large = Needs(memory_gb=1), Needs(gpu=True, memory_gb=6)
    executor = LocalExecutor(ExecutionConfig(workers=4), Path(os.environ["PREFECT_HOME"]).parent / "logs")
    try:
        executor.memory_gb = 8.0
        assert executor.room(large, Counter()) == 4, "one is always let in"
        assert executor.room(large, Counter({large: 1})) == 0
        assert executor.room(small, Counter({large: 1})) == 2
        assert executor.room(small, Counter({large: 1, small: 3})) == 0
        assert np.isclose(executor.room(small, Counter({small: 1})), 3)
    finally:
        executor.close()
