"""Environments of companies and containers: a proxy, no home, settings of Prefect for another server."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest

from flows.errors import describe
from flows.pipeline import disk
from flows.pipeline.server import quiet_environment
from schemas.errors import StoreError
from tests.flows.conftest import ROOT

SCENE = "procedural:llff/2?views=5&width=24&height=20"


def run(
    source: str, out: Path | str, environment: dict[str, str] | None = None, cwd: Path | None = None
) -> subprocess.CompletedProcess[str]:
    """`cat3d run`, as small as it gets, in a process of its own."""
    command = [
        sys.executable, "-m", "flows.cli", "run", source, "--out", str(out), "--views", "3",
        "--preset", "tiny", "--set", "render.path=none", "--set", "evaluate.lpips=false",
        "--set", "reconstruct.overrides={iterations: 4, warmup_iterations: 1}",
    ]  # fmt: skip
    environment = environment or os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    return subprocess.run(
        command, env=environment, cwd=cwd or ROOT, capture_output=True, text=True, encoding="utf-8", errors="replace",
        timeout=280,
    )  # fmt: skip


def test_what_failed_on_a_full_disk_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    failure = RuntimeError("a task failed")
    failure.__cause__ = OSError(errno.ENOSPC, "No space left on device", "chunk")
    with pytest.raises(StoreError, match=r"The disk /.*, on which .* is, is full"), disk.naming_full_disk(tmp_path):
        raise failure
    with pytest.raises(RuntimeError, match="another"), disk.naming_full_disk(tmp_path / "not" / "there"):
        raise RuntimeError("another")
    monkeypatch.setattr(disk, "FULL_BYTES", 2**62)  # whatever is free is too little
    with pytest.raises(StoreError, match="are free"), disk.naming_full_disk(tmp_path):
        raise RuntimeError("Server error '500 Internal Server Error'")


def test_this_machine_is_reached_without_the_proxy(monkeypatch, tmp_path: Path) -> None:
    monkeypatch.setenv("NO_PROXY", "intern.example, 10.0.0.0/8")
    monkeypatch.delenv("no_proxy", raising=False)
    environment = quiet_environment(tmp_path)
    assert environment["NO_PROXY"] == environment["no_proxy"] == "intern.example,10.0.0.0/8,127.0.0.1,localhost"


def test_a_run_behind_a_proxy_without_a_home_and_with_prefect_settings_of_another_server(tmp_path: Path) -> None:
    """The proxy answers nothing, the base path would move our server's address, and there is no home at all."""
    (tmp_path / "file").write_text("no folder, so that no home can be made below it")
    environment = {
        "PATH": os.environ["PATH"], "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1",
        "HTTP_PROXY": "http://127.0.0.1:9", "http_proxy": "http://127.0.0.1:9", "ALL_PROXY": "http://127.0.0.1:9",
        "PREFECT_SERVER_API_BASE_PATH": "/elsewhere", "PREFECT_PROFILE": "nobody",
        "HOME": str(tmp_path / "file" / "home"),
    }  # fmt: skip
    done = run(SCENE, tmp_path / "out", environment)
    assert done.returncode == 0, done.stderr[-2000:]
    assert (tmp_path / "out" / "report.html").exists()


def test_a_failing_server_is_a_sentence_with_the_cause() -> None:
    kind = type("PrefectHTTPStatusError", (Exception,), {})
    sentence = describe(kind("Server error '500 Internal Server Error'\nmore"))
    assert sentence is not None
    assert "500 Internal Server Error" in sentence
    assert "full" in sentence
