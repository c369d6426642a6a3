"""The deployments of infra/prefect.yaml as a team uses them: deploy, worker, runs to the end, cancelled, scheduled."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from uuid import UUID

import pytest
from prefect import Flow
from prefect.client.orchestration import SyncPrefectClient, get_client
from prefect.client.schemas.filters import FlowRunFilter, FlowRunFilterId
from prefect.client.schemas.objects import FlowRun
from prefect.utilities.callables import parameter_schema

from flows.commands import deployed
from flows.pipeline.prefect_records import settle, slug
from flows.pipeline.server import prefect_server
from flows.stages import STAGES
from tests.flows.conftest import ROOT, environment
from tests.flows.pipeline.test_sweep import BASE

SCENE = "procedural:llff/2?views=6&width=24&height=20"
#: Loaded machines take minutes where a free one takes seconds.
PATIENCE_S = 600.0


@pytest.mark.parametrize("made", [deployed.run, deployed.sweep, deployed.reprocess], ids=lambda f: f.name)
def test_parameters_are_described_for_prefects_interface(made: Flow[Any, Any]) -> None:
    schema = json.loads(parameter_schema(made).model_dump_json())
    assert all(p.get("description") or p.get("title") for p in schema["properties"].values())
    assert {"out"} <= set(schema["required"])
    assert made.description
    if made is deployed.run:
        settings = schema["definitions"]["ReconstructConfig"]["properties"]
        assert settings["preset"]["description"].startswith("Point on the measured front")


def test_stages_can_be_chosen_in_the_interface() -> None:
    assert tuple(stage.name for stage in STAGES) == deployed.StageName.__args__


def test_names_of_folders_become_keys_of_artifacts() -> None:
    assert slug(Path("/data/My results_2")) == "my-results-2"
    assert slug(Path("/")) == "results"


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SyncPrefectClient]:
    """Of a server of its own with a work pool, the deployments of infra/prefect.yaml, and a worker."""
    home = tmp_path_factory.mktemp("prefect")
    with prefect_server(home), get_client(sync_client=True) as client:
        prefect("work-pool", "create", "cat3d", "--type", "process")
        prefect("deploy", "--all", "--prefect-file", "infra/prefect.yaml")
        with open(home / "worker.log", "wb") as log:
            worker = subprocess.Popen(
                [sys.executable, "-m", "prefect", "worker", "start", "--pool", "cat3d", "--name", "w"], cwd=ROOT,
                env=environment() | {"PREFECT_WORKER_QUERY_SECONDS": "2", "PYTHONPATH": str(ROOT)}, stdout=log,
                stderr=log,
            )  # fmt: skip
        yield client
        worker.send_signal(signal.SIGINT)
        worker.wait(60)


def prefect(*arguments: str) -> str:
    done = subprocess.run(
        [sys.executable, "-m", "prefect", "--no-prompt", *arguments], cwd=ROOT, capture_output=True, text=True,
        env=environment() | {"PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def begun(client: SyncPrefectClient, deployment: str, parameters: dict[str, Any], *options: str) -> UUID:
    """Ask for a run of a deployment."""
    given = [text for name, value in parameters.items() for text in ("--param", f"{name}={json.dumps(value)}")]
    found = {run.id for run in client.read_flow_runs()}
    prefect("deployment", "run", deployment, *given, *options)
    [new] = [run.id for run in client.read_flow_runs() if run.id not in found and run.parent_task_run_id is None]
    return new


def waited(client: SyncPrefectClient, run: UUID, until: Callable[[FlowRun], Any]) -> FlowRun:
    deadline = time.monotonic() + PATIENCE_S
    while not until(now := client.read_flow_run(run)):
        assert time.monotonic() < deadline, f"{now.name} is {now.state}"
        time.sleep(0.5)
    return now


def over(run: FlowRun) -> bool:
    return run.state is not None and run.state.is_final()


TINY = {"reconstruct": BASE["reconstruct"], "render": {"path": "none"}, "evaluate": {"lpips": False}}


@pytest.mark.slow
def test_a_deployment_runs_is_scheduled_and_cancelled(client: SyncPrefectClient, tmp_path: Path) -> None:
    out = tmp_path / "Results of a team"
    asked = {"source": SCENE, "out": str(out), "views": ["3"], "config": TINY}
    done = waited(client, begun(client, "run/run", asked), over)
    assert done.state is not None
    assert done.state.is_completed(), done.state.message
    assert (out / "report.html").exists()
    artifacts = {a["key"]: a for a in client._client.post("/artifacts/filter", json={}).json()}
    assert "| procedural_llff_2 | 3 | zipnerf |" in artifacts["cat3d-metrics-results-of-a-team"]["data"]
    assert (out / "report.html").as_uri() in artifacts["cat3d-report-results-of-a-team"]["data"]
    assert artifacts["cat3d-progress-results-of-a-team"]["data"] == 100.0
    tags = [set(task.tags) for task in client.read_task_runs()]
    assert any({"reconstruct", "procedural_llff_2", "v3-zipnerf"} <= own for own in tags)

    again = waited(client, begun(client, "reprocess/reprocess", {"out": str(out)}, "--start-in", "3 seconds"), over)
    assert again.state is not None
    assert again.state.is_completed(), "scheduled, and nothing to do"
    assert again.expected_start_time is not None
    assert (again.expected_start_time - again.created).total_seconds() > 2

    endless = TINY | {"reconstruct": {"overrides": BASE["reconstruct"]["overrides"] | {"iterations": 10**7}}}
    long = begun(client, "run/run", asked | {"out": str(tmp_path / "long"), "config": endless})
    waited(client, long, lambda _: (tmp_path / "long" / "procedural_llff_2.zarr").exists())
    prefect("flow-run", "cancel", str(long))
    ended = waited(client, long, over)
    assert ended.state is not None
    assert ended.state.is_cancelled()


@pytest.mark.slow
def test_a_killed_commands_flow_is_settled_by_the_next_one(client: SyncPrefectClient, tmp_path: Path) -> None:
    overrides = json.dumps(BASE["reconstruct"]["overrides"] | {"iterations": 10**7})
    process = subprocess.Popen(
        [sys.executable, "-m", "flows.cli", "run", SCENE, "--views", "3", "--out", str(tmp_path), "--set",
         f"reconstruct.overrides={overrides}"], cwd=ROOT, env=environment(), stdout=subprocess.DEVNULL,
    )  # fmt: skip
    mine: list[FlowRun] = []
    deadline = time.monotonic() + PATIENCE_S
    while not mine:
        assert time.monotonic() < deadline
        time.sleep(0.5)
        mine = [r for r in client.read_flow_runs() if (r.infrastructure_pid or "").endswith(f":{process.pid}")]
    assert settle(client) == [], "it lives"
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    assert settle(client) == [mine[0].id]
    [after] = client.read_flow_runs(flow_run_filter=FlowRunFilter(id=FlowRunFilterId(any_=[mine[0].id])))
    assert after.state is not None
    assert after.state.is_crashed()
    assert "was killed" in (after.state.message or "")
