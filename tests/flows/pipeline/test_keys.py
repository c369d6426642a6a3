"""The list of stages, what follows from it, and a stage that a stranger adds."""

from __future__ import annotations

import numpy as np
import pytest

from flows.jobs import scene
from flows.jobs.job import Job, Outcome
from flows.jobs.request import Request, make_config
from flows.jobs.stage import Stage
from flows.pipeline import keys
from flows.pipeline.keys import downstream, pending, upstream
from flows.pipeline.runner import opened, run_missing
from flows.stages import STAGES
from schemas.layout import LAYOUT, array_spec
from schemas.scene_store import SceneStore

NAMES = [stage.name for stage in STAGES]
SOURCE = "procedural:dtu/3?views=9&width=32&height=24"


def test_downstream_follows_the_data() -> None:
    assert downstream("ingest") == tuple(NAMES)
    assert downstream("encode") == ("encode", "sample", "decode", "reconstruct", "render", "evaluate")
    assert downstream("evaluate") == ("evaluate",)
    assert upstream("plan") == ("ingest", "poses", "plan")
    with pytest.raises(ValueError, match="'cook' is not a stage"):
        downstream("cook")


def test_every_stage_reads_earlier_ones_and_every_array_is_of_a_stage() -> None:
    assert all(NAMES.index(read) < NAMES.index(stage.name) for stage in STAGES for read in stage.reads)
    assert {spec.stage for spec in LAYOUT} - {None} <= set(NAMES)
    assert [stage.name for stage in STAGES if stage.per == "scene"] == ["ingest", "poses", "encode"]


def test_a_stage_is_added_by_its_module_and_its_line_in_the_list(monkeypatch: pytest.MonkeyPatch, tmp_path) -> None:
    """What CONTRIBUTING.md says: a declaration and a line; here it needs no arrays of its own."""

    def execute(job: Job, store: SceneStore, key: str) -> Outcome:
        mean = float(np.mean(store.captured.read("image")))
        store.run(job.run).set_attrs(brightness=mean)
        return Outcome({"views": len(job.capture())})

    brightness = Stage("brightness", execute, version=1, reads=("ingest",))
    monkeypatch.setattr(keys, "STAGES", (*STAGES, brightness))
    [job] = Request(SOURCE, tmp_path, ("3",), make_config({"method": "zipnerf"}, None, [])).jobs()
    with opened(job):
        records = run_missing(job, until="brightness")
        assert [record.stage for record in records] == ["ingest", "brightness"]
        assert run_missing(job, until="brightness") == []
    assert SceneStore.open(job.store_path).run(job.run).attrs["brightness"] > 0
    darker = job.model_copy(update={"config": make_config({"method": "zipnerf", "downscale": 2}, None, ["split=3"])})
    why = {step.stage: step.why for step in pending(darker)}
    assert "ingest" in why["brightness"]


def test_photos_are_read_and_hashed_once_however_many_jobs_ask(monkeypatch: pytest.MonkeyPatch, tmp_path) -> None:
    counts = {"read": 0, "hashed": 0}
    read, hashed = scene.read_capture, scene.capture_digests

    def counted(name, function):
        def call(*arguments):
            counts[name] += 1
            return function(*arguments)

        return call

    monkeypatch.setattr(scene, "read_capture", counted("read", read))
    monkeypatch.setattr(scene, "capture_digests", counted("hashed", hashed))
    jobs = Request(SOURCE, tmp_path, ("1", "3"), make_config({"method": "zipnerf"}, None, [])).jobs()
    with opened(jobs[0]):
        for job in jobs:
            run_missing(job, until="poses")
            assert pending(job)
    assert counts == {"read": 1, "hashed": 1}


def test_the_layout_knows_no_stage_but_those_of_its_arrays() -> None:
    assert array_spec("runs/v3/plan/intrinsics").stage == "plan"
