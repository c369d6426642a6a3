"""The command's own Prefect server: loopback only, shared, gone with its command however that ends."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from flows.errors import ServerError
from flows.pipeline.server import prefect_server
from tests.flows.conftest import ROOT

HOLD = """
import sys, time
from pathlib import Path
from flows.pipeline.server import prefect_server
with prefect_server(Path(sys.argv[1])) as url:
    print(url, flush=True)
    time.sleep(60)
"""


def listening(port: int) -> bool:
    """Whether something listens on the loopback port (IPv4), and on nothing wider."""
    lines = Path("/proc/net/tcp").read_text().splitlines()[1:]
    local = [line.split()[1] for line in lines if line.split()[3] == "0A"]
    assert f"00000000:{port:04X}" not in local, "the server listens on every interface"
    return f"0100007F:{port:04X}" in local


@pytest.mark.parametrize("kind", [signal.SIGTERM, signal.SIGKILL])
def test_server_is_on_loopback_and_dies_with_its_command(tmp_path: Path, kind: signal.Signals) -> None:
    environment = {k: v for k, v in os.environ.items() if k != "PREFECT_API_URL"}
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(tmp_path)], cwd=ROOT, env=environment, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    url = process.stdout.readline().strip()
    port = int(url.split(":")[2].split("/")[0])
    assert listening(port)
    process.send_signal(kind)
    process.wait(20)
    deadline = time.monotonic() + 15
    while listening(port) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not listening(port)


def test_the_users_server_is_used_and_a_missing_one_is_named(tmp_path: Path, monkeypatch) -> None:
    from flows.pipeline import server

    monkeypatch.setenv("PREFECT_API_URL", "http://127.0.0.1:9/api")
    wait = server._wait_until_healthy
    monkeypatch.setattr(server, "_wait_until_healthy", lambda url, process, timeout: wait(url, process, 0.5))
    missing = pytest.raises(ServerError, match="No Prefect server answered at http://127.0.0.1:9/api")
    with missing, prefect_server(tmp_path):
        pass
    assert not (tmp_path / "prefect.db").exists()


def test_sigterm_reaches_our_handler_after_pycolmap_is_loaded() -> None:
    code = (
        "import os, signal, sys\n"
        "signal.signal(signal.SIGTERM, lambda *_: sys.exit(7))\n"
        "import flows.sfm.poses\n"
        "os.kill(os.getpid(), signal.SIGTERM)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 7
    assert "stack trace" not in done.stderr
