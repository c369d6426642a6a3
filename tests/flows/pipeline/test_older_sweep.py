"""A finished sweep made by an older version is complete for this one: nothing is done again.

Its preset `fast` is given here as it was then: what a preset says is part of a field's key, on purpose, and it has been
changed since (tests/flows/commands/test_reprocess.py).
"""

from __future__ import annotations

import os
import tarfile
from dataclasses import replace
from pathlib import Path

import pytest

from cat3d_core.zipnerf import PRESETS
from flows.jobs.metric_table import metric_table
from flows.pipeline.sweep import open_jobs, run_sweep, sweep_jobs
from schemas.config import SweepConfig, load_config
from schemas.tables import TIMINGS, read_rows

FIXTURE = Path(__file__).parents[2] / "fixtures" / "sweep_of_0888913.tar.gz"


def test_a_sweep_of_commit_0888913_is_not_redone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with tarfile.open(FIXTURE) as archive:
        archive.extractall(tmp_path, filter="data")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(PRESETS, "fast", replace(PRESETS["fast"], multisamples=6, lr_final=0.001, depth_prior=0.0))
    config = load_config(Path("sweep.yaml"), SweepConfig)
    out = Path("out").resolve()
    scenes, problems = sweep_jobs(config, out)
    assert not problems
    assert [job.run for jobs in scenes for job in jobs] == ["v3-zipnerf", "v3-cat3d"]
    assert [open_jobs(jobs) for jobs in scenes] == [[]]
    executed = read_rows(out / "timings", TIMINGS).num_rows
    metrics = read_rows(out / "metrics", metric_table()).to_pylist()
    assert run_sweep(config, out) == []
    assert read_rows(out / "timings", TIMINGS).num_rows == executed
    assert read_rows(out / "metrics", metric_table()).to_pylist() == metrics
    assert os.path.getsize(out / "report.html") > 0
