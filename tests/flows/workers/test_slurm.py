"""A sweep on SLURM, where there is one (`infra/slurm/one_node.sh` makes one of this machine): equal results, also when
jobs are cancelled."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest

from flows.pipeline.sweep import run_sweep
from schemas.scene_store import SceneStore
from tests.flows.conftest import ROOT
from tests.flows.pipeline.test_side_by_side import SOURCE, metrics_of, stages_of_timings, swept
from tests.flows.pipeline.test_sweep import TRAINER, sweep_of


def partition() -> str:
    """The first partition of SLURM; skips where there is none."""
    pytest.importorskip("dask_jobqueue", reason="dask-jobqueue is not installed: pip install dask-jobqueue.")
    if shutil.which("sinfo") is None:
        pytest.skip("SLURM is not installed here: apt-get install slurm-wlm munge; infra/slurm/one_node.sh start.")
    found = subprocess.run(["sinfo", "-h", "-o", "%R"], capture_output=True, text=True, timeout=20)
    if found.returncode or not found.stdout.strip():
        pytest.skip("SLURM does not answer here: sudo bash infra/slurm/one_node.sh start.")
    return found.stdout.split()[0]


def slurm(out: Path, walltime: str = "00:10:00") -> dict[str, Any]:
    """Settings of two jobs with a worker each on this machine."""
    return {
        "executor": "dask", "workers": 2, "dask_cluster": "dask_jobqueue.SLURMCluster",
        "dask_options": {
            "queue": partition(), "cores": 1, "processes": 1, "memory": "3GB", "walltime": walltime,
            "python": sys.executable, "log_directory": str(out / "slurm"), "interface": "lo",
            "scheduler_options": {"host": "127.0.0.1", "dashboard_address": "127.0.0.1:0"},
        },
    }  # fmt: skip


@pytest.fixture
def importable(monkeypatch: pytest.MonkeyPatch) -> None:
    """Jobs find this checkout."""
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]))


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_a_sweep_on_slurm_whose_jobs_are_cancelled_gives_the_table_of_one_process(
    tmp_path: Path, prefect_url: str, importable: None
) -> None:
    longer = {"reconstruct": {"overrides": TRAINER | {"iterations": 1500}}, "skip": {"plateau": False}}
    methods, out = {"a": longer, "b": longer | {"seed": 1}}, tmp_path / "slurm"
    settings, cancelled = slurm(tmp_path), list[str]()

    def cancel() -> None:
        while not list((out / ".work").glob("*-reconstruct.pulse")):
            time.sleep(0.1)
        jobs = subprocess.run(["squeue", "-h", "-t", "R", "-o", "%i"], capture_output=True, text=True).stdout.split()
        subprocess.run(["scancel", jobs[0]], check=True)
        cancelled.append(jobs[0])

    threading.Thread(target=cancel, daemon=True).start()
    assert run_sweep(sweep_of(SOURCE, methods=methods, base={"execution": settings}), out) == []
    assert cancelled
    assert metrics_of(out) == swept(tmp_path / "here", SOURCE, methods=methods, workers=1)
    assert stages_of_timings(out) == stages_of_timings(tmp_path / "here"), "nothing was done twice"


@pytest.mark.slow
@pytest.mark.timeout(1500)
def test_jobs_that_end_by_their_time_limit_are_replaced_and_the_training_goes_on(
    tmp_path: Path, prefect_url: str, importable: None
) -> None:
    """A reconstruction that takes longer than a job may: a job is ended after one to two minutes."""
    long = {"reconstruct": {"overrides": TRAINER | {"iterations": 10000}}, "skip": {"plateau": False}}
    settings = slurm(tmp_path, walltime="00:01:00") | {"workers": 1}
    out = tmp_path / "slurm"
    assert run_sweep(sweep_of(SOURCE, methods={"a": long}, base={"execution": settings}), out) == []
    ended = [path for path in (tmp_path / "slurm").glob("*.err") if "DUE TO TIME LIMIT" in path.read_text()]
    assert ended
    record = SceneStore.open(out / "procedural_llff_2.zarr").record("reconstruct", "v3-a")
    assert record is not None
    assert any(d.text.startswith("Went on from the checkpoint at iteration") for d in record.decisions)
    assert metrics_of(out) == swept(tmp_path / "here", SOURCE, methods={"a": long}, workers=1)
