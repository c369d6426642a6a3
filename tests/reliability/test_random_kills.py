"""Whole sweeps in which workers, the scheduler, the command and Prefect's server are killed at random.

CAT3D_KILLS says how many (6 if not set; 20 take about ten minutes of two cores).
"""

from __future__ import annotations

import os
import random
import signal
import socket
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

import psutil
import pytest
import yaml

from flows.jobs.metric_table import metric_table
from schemas.layout import SCENE_STAGES
from schemas.scene_store import SceneStore
from schemas.tables import TIMINGS, read_rows
from schemas.verify import verify
from tests.flows.conftest import ROOT, environment
from tests.flows.pipeline.test_sweep import TRAINER
from tests.flows.workers.scene import random_model

KILLS = int(os.environ.get("CAT3D_KILLS", "6"))
PATIENCE_S = 1800.0


def sweep_document(model: Path) -> dict[str, Any]:
    generated = {"method": "cat3d", "plan": {"views": 8}, "skip": {"covered_path": False},
                 "sample": {"checkpoint": str(model), "steps": 2}}  # fmt: skip
    return {
        "name": "kills",
        "scenes": [{"source": f"procedural:{f}/2?views=9&width=24&height=20"} for f in ("llff", "dtu")],
        "splits": ["3"],
        "methods": {"zipnerf": {"method": "zipnerf"}, "cat3d": generated},
        "seeds": [0, 1],
        "base": {
            "reconstruct": {"overrides": TRAINER | {"iterations": 200}}, "render": {"path": "none"},
            "skip": {"plateau": False}, "evaluate": {"lpips": False},
        },
    }  # fmt: skip


class Cluster:
    """A Dask scheduler with two workers, each a process that is started anew when it was killed."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.address = f"tcp://127.0.0.1:{free.getsockname()[1]}"
        self.processes: dict[str, subprocess.Popen[bytes]] = {}

    def restore(self) -> None:
        """Start what is not running."""
        port = self.address.rsplit(":", 1)[1]
        worker = ["worker", self.address, "--nthreads", "1", "--no-dashboard", "--local-directory", str(self.folder)]
        wanted = {
            "scheduler": ["scheduler", "--host", "127.0.0.1", "--port", port, "--no-dashboard"],
            "worker 1": [*worker, "--death-timeout", "60"],
            "worker 2": [*worker, "--death-timeout", "60"],
        }
        for name, arguments in wanted.items():
            if name not in self.processes or self.processes[name].poll() is not None:
                if name == "scheduler":
                    self.close()  # workers do not find to a new scheduler by themselves: who runs them starts new ones
                self.processes[name] = subprocess.Popen(
                    [sys.executable, "-m", "distributed.cli.dask_" + arguments[0], *arguments[1:]], cwd=ROOT,
                    env=environment() | {"PYTHONPATH": str(ROOT)}, stdout=subprocess.DEVNULL,
                    stderr=subprocess.DEVNULL,
                )  # fmt: skip

    def close(self) -> None:
        for process in self.processes.values():
            for child in [*psutil.Process(process.pid).children(recursive=True)] if process.poll() is None else []:
                child.kill()
            process.kill()
            process.wait()


def victims(command: psutil.Process, cluster: Cluster | None) -> dict[str, psutil.Process]:
    """What can be killed now."""
    found = {"command": command}
    for child in command.children(recursive=True):
        try:
            line = " ".join(child.cmdline())
        except psutil.Error:
            continue
        if "flows.workers.worker" in line:
            found["worker"] = child
        elif "prefect" in line and "server" in line:
            found["Prefect's server"] = child
    if cluster is not None:
        for name, process in cluster.processes.items():
            if process.poll() is None:
                found[name] = psutil.Process(process.pid)
                for child in found[name].children() if "worker" in name else []:
                    if "spawn_main" in " ".join(child.cmdline()):  # what does the work, and not its keeper
                        found[name] = child
    return found


def run_to_its_end(
    document: Path, out: Path, settings: list[str], chance: random.Random, kills: int, cluster: Cluster | None = None
) -> list[str]:
    """Start the sweep again until it is complete, killing something now and then; what was killed."""
    killed: list[str] = []
    deadline = time.monotonic() + PATIENCE_S
    while True:
        assert time.monotonic() < deadline, f"not complete after {len(killed)} kills: {killed}"
        if cluster is not None:
            cluster.restore()
        with open(out.with_suffix(".log"), "ab") as log:
            command = subprocess.Popen(
                [sys.executable, "-m", "flows.cli", "sweep", str(document), "--out", str(out), *settings], cwd=ROOT,
                env=environment() | {"PYTHONPATH": str(ROOT)}, stdout=log, stderr=log, start_new_session=True,
            )  # fmt: skip
        process = psutil.Process(command.pid)
        next_kill = time.monotonic() + chance.uniform(4, 16)
        while command.poll() is None:
            time.sleep(0.1)
            if cluster is not None:
                cluster.restore()
            if len(killed) < kills and time.monotonic() > next_kill:
                try:
                    found = victims(process, cluster)
                    if len(found) > 1 and chance.random() < 0.75:  # else it is the command nearly always
                        del found["command"]
                    name, victim = chance.choice(sorted(found.items()))
                    victim.send_signal(signal.SIGKILL)
                except psutil.Error:
                    continue
                killed.append(name)
                next_kill = time.monotonic() + chance.uniform(4, 16)
        if command.returncode == 0:
            return killed


def table(out: Path) -> list[dict[str, Any]]:
    return read_rows(out / "metrics", metric_table()).to_pylist()


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_sweeps_with_random_kills_lose_nothing_do_nothing_twice_and_give_equal_tables(tmp_path: Path) -> None:
    chance = random.Random(20)
    document = tmp_path / "sweep.yaml"
    document.write_text(yaml.safe_dump(sweep_document(random_model(tmp_path / "tiny.safetensors"))))
    one = ["--set", "execution.workers=1"]
    assert run_to_its_end(document, tmp_path / "undisturbed", one, chance, kills=0) == []
    wanted = table(tmp_path / "undisturbed")
    assert len(wanted) == 2 * 2 * 2 * 2, "scenes, methods, seeds, held-out views"
    cluster, killed = Cluster(tmp_path), list[str]()
    ways: dict[str, tuple[list[str], Cluster | None]] = {
        "processes": (["--set", "execution.workers=2"], None),
        "dask": (["--set", "execution.executor=dask", "--set", f"execution.dask_address={cluster.address}"], cluster),
    }
    try:
        number = 0
        while len(killed) < KILLS:
            name, (settings, helpers) = list(ways.items())[number % 2]
            out = tmp_path / f"{name}{number}"
            share = min(KILLS - len(killed), max(1, KILLS // 4))
            killed += run_to_its_end(document, out, settings, chance, share, helpers)
            assert table(out) == wanted, f"{out.name} after {killed}"
            stores = [SceneStore.open(path) for path in sorted(out.glob("*.zarr"))]
            assert [problem for store in stores for problem in verify(store)] == []
            done = Counter(
                (row["scene_id"], "" if row["stage"] in SCENE_STAGES else row["run"], row["stage"], row["key"])
                for row in read_rows(out / "timings", TIMINGS).to_pylist()
            )
            assert [what for what, count in done.items() if count > 1] == [], "nothing is done twice"
            number += 1
    finally:
        cluster.close()
    print(f"{len(killed)} kills in {number} sweeps: {dict(Counter(killed))}")
