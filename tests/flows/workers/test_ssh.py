"""A sweep on workers that are started over SSH, on this machine where it lets itself in: equal results."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.flows.conftest import ROOT
from tests.flows.pipeline.test_side_by_side import SOURCE, stages_of_timings, swept


@pytest.fixture
def host() -> str:
    """This machine, reached without a password; skips where it is not."""
    pytest.importorskip("asyncssh", reason="asyncssh is not installed: pip install asyncssh.")
    asked = ["ssh", "-o", "BatchMode=yes", "-o", "ConnectTimeout=5", "127.0.0.1", "true"]
    if shutil.which("ssh") is None or subprocess.run(asked, capture_output=True).returncode:
        pytest.skip("ssh 127.0.0.1 does not work here without a password.")
    return "127.0.0.1"


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_sweep_over_ssh_gives_the_table_of_one_process(tmp_path: Path, prefect_url: str, host: str) -> None:
    python = f"env PYTHONPATH={ROOT} {sys.executable}"
    options = {
        "hosts": [host, host, host], "connect_options": {"known_hosts": None}, "remote_python": python,
        "worker_options": {"nthreads": 1}, "scheduler_options": {"port": 0, "dashboard_address": "127.0.0.1:0"},
    }  # fmt: skip
    methods = {"a": {"method": "zipnerf"}, "b": {"method": "zipnerf", "seed": 1}}
    over_ssh = swept(tmp_path / "ssh", SOURCE, methods=methods, executor="dask",
                     dask_cluster="distributed.SSHCluster", dask_options=options)  # fmt: skip
    assert over_ssh == swept(tmp_path / "here", SOURCE, methods=methods, workers=1)
    assert stages_of_timings(tmp_path / "ssh") == stages_of_timings(tmp_path / "here"), "nothing was done twice"
