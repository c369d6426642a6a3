"""The list of stages, what follows from it, and a stage that a stranger adds."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from flows.jobs import scene
from flows.jobs.request import Request, make_config
from flows.pipeline.keys import downstream, pending, upstream
from flows.pipeline.runner import opened, run_missing
from flows.stages import STAGES
from schemas.layout import LAYOUT

NAMES = [stage.name for stage in STAGES]
ROOT = Path(__file__).resolve().parents[3]
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


MODULE = '''
"""Stage brightness: the mean of each captured view."""

from flows.jobs.access import read_images
from flows.jobs.job import Outcome
from flows.jobs.stage import Stage


def execute(job, store, key):
    views = range(len(store.captured.read("name")))
    means = [float(image.float().mean()) for image in read_images(store.captured, views)]
    store.captured.write("brightness", np.array(means))
    return Outcome({"views": len(means)})


STAGE = Stage("brightness", execute, version=1, reads=("ingest",))
'''
TABLE = "LAYOUT: tuple[ArraySpec, ...] = (\n"
ARRAY = 'ArraySpec("captured/brightness", "small", "float64", (VIEW,), "brightness", "1", "mean of the pixels"),'
USE = """
import json, sys
from pathlib import Path
from flows.jobs.request import make_request
from flows.pipeline.keys import downstream, pending
from flows.pipeline.runner import opened, run_missing
from flows.reporting.inspect import inspect_store

def job(*settings):
    return make_request("procedural:dtu/3?views=9&width=32&height=24", Path(sys.argv[1]), "3", {"method": "zipnerf"},
                        settings=settings).jobs()[0]

with opened(job()):
    done = [[record.stage for record in run_missing(job(), until="brightness")] for _ in range(2)]
rows = {row["stage"]: row for row in inspect_store(job().store_path, verify_chunks=True)["stages"]}
stale = [step.stage for step in pending(job("ingest.downscale=2")) if step.why == "ingest changed"]
print(json.dumps([done, rows["brightness"]["run"], rows["brightness"]["complete"], "brightness" in stale,
                  downstream("brightness"), inspect_store(job().store_path)["ok"]]))
"""


def test_a_stranger_adds_a_stage_by_a_module_its_arrays_and_a_line(tmp_path: Path) -> None:
    """In a copy of the program, where three files differ: the new module, its line in the layout, that in the list."""
    for name in ("flows", "schemas"):
        shutil.copytree(ROOT / name, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__"))
    (tmp_path / "cat3d_core").symlink_to(ROOT / "cat3d_core")
    (tmp_path / "flows" / "stages" / "brightness.py").write_text("import numpy as np\n" + MODULE)
    for path, before, after in (
        ("flows/stages/__init__.py", "    ingest.STAGE,\n", "    ingest.STAGE,\n    brightness.STAGE,\n"),
        ("flows/stages/__init__.py", "import decode,", "import brightness, decode,"),
        ("schemas/layout.py", TABLE, f"{TABLE}    {ARRAY}\n"),
    ):
        text = (tmp_path / path).read_text()
        assert text.count(before) == 1, path
        (tmp_path / path).write_text(text.replace(before, after))
    environment = os.environ | {"PYTHONPATH": str(tmp_path)}
    arguments = [sys.executable, "-c", USE, str(tmp_path / "out")]
    done = subprocess.run(arguments, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout.splitlines()[-1]) == [
        [["ingest", "brightness"], []], None, True, True, ["brightness"], True
    ]  # fmt: skip


def test_photos_are_read_and_hashed_once_however_many_jobs_ask(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    counts = {"read": 0, "hashed": 0}
    read, hashed = scene.read_capture, scene.capture_digests

    def counted(name, function):
        def call(*arguments, **named):
            counts[name] += 1
            return function(*arguments, **named)

        return call

    monkeypatch.setattr(scene, "read_capture", counted("read", read))
    monkeypatch.setattr(scene, "capture_digests", counted("hashed", hashed))
    jobs = Request(SOURCE, tmp_path, ("1", "3"), make_config({"method": "zipnerf"}, None, [])).jobs()
    with opened(jobs[0]):
        for job in jobs:
            run_missing(job, until="poses")
            assert pending(job)
    assert counts == {"read": 1, "hashed": 1}
