"""What Prefect shows of a flow besides its tasks: whose it is, how far it is, and what came of it.

A flow whose process was killed stays "Running" in Prefect's database for ever, as nobody is left to say otherwise. So
each flow writes down its process when it begins, and settles what dead processes of this machine left behind.
"""

from __future__ import annotations

import os
import platform
import re
import threading
import time
from pathlib import Path
from typing import Any, cast
from uuid import UUID

from prefect.artifacts import (
    create_link_artifact,
    create_markdown_artifact,
    create_progress_artifact,
    update_progress_artifact,
)
from prefect.client.orchestration import SyncPrefectClient, get_client
from prefect.client.schemas.filters import (
    FlowRunFilter,
    FlowRunFilterId,
    FlowRunFilterState,
    FlowRunFilterStateType,
    TaskRunFilter,
    TaskRunFilterState,
    TaskRunFilterStateType,
)
from prefect.client.schemas.objects import StateType
from prefect.context import FlowRunContext
from prefect.states import Crashed, State

from flows.locks import lives
from flows.reporting.report import REPORT
from flows.reporting.summary import markdown, paper_tables, summary_rows

#: Seconds between two updates of a progress artifact.
UPDATE_S = 5.0


def claim() -> None:
    """Write down that the flow that calls this is this process's, and settle those of dead ones. Outside of a flow
    there is nothing to write down."""
    context = FlowRunContext.get()
    if context is None or context.flow_run is None:
        return
    with get_client(sync_client=True) as client:
        client.update_flow_run(context.flow_run.id, infrastructure_pid=f"{platform.node()}:{os.getpid()}")
        settle(client)


def settle(client: SyncPrefectClient) -> list[UUID]:
    """Mark flows as crashed, with their tasks, that are Running by Prefect and whose process on this machine is gone.
    Returns their ids. Those of other machines are left to those."""
    running = FlowRunFilterState(type=FlowRunFilterStateType(any_=[StateType.RUNNING]))
    settled = []
    for run in client.read_flow_runs(flow_run_filter=FlowRunFilter(state=running)):
        host, _, pid = (run.infrastructure_pid or "").rpartition(":")
        since = run.start_time.timestamp() if run.start_time else None
        if host != platform.node() or not pid.isdigit() or lives(int(pid), since):
            continue
        state: State[Any] = Crashed(
            message=f"Its process {pid} on {host} is gone: it was killed. Run it again to go on."
        )
        client.set_flow_run_state(run.id, state, force=True)
        tasks = client.read_task_runs(
            flow_run_filter=FlowRunFilter(id=FlowRunFilterId(any_=[run.id])),
            task_run_filter=TaskRunFilter(
                state=TaskRunFilterState(type=TaskRunFilterStateType(any_=[StateType.RUNNING, StateType.PENDING]))
            ),
        )
        for task in tasks:
            client.set_task_run_state(task.id, state, force=True)
        settled.append(run.id)
    return settled


def is_deployed() -> bool:
    """Whether a Prefect worker started this process for a run of a deployment."""
    return "PREFECT__FLOW_RUN_ID" in os.environ


def publish(out: Path) -> None:
    """Artifacts of an output folder: its table of metrics, and the link to its report."""
    rows = summary_rows(out)
    name = slug(out)
    if rows:
        text = markdown(rows, paper_tables(rows))
        create_markdown_artifact(text, key=f"cat3d-metrics-{name}", description=f"Metrics of the runs in {out}")
    link = (out / REPORT).as_uri()
    create_link_artifact(link, f"Report of {out}", key=f"cat3d-report-{name}", description=f"On the machine with {out}")


def slug(out: Path) -> str:
    """A folder's name as part of the key of an artifact."""
    return re.sub(r"[^a-z0-9]+", "-", out.name.lower()).strip("-") or "results"


class Advance:
    """A progress artifact of a flow, made when there is something to say; for any thread with the flow's context."""

    def __init__(self, out: Path) -> None:
        self.key, self.lock = f"cat3d-progress-{slug(out)}", threading.Lock()
        self.artifact: UUID | None = None
        self.next = 0.0

    def __call__(self, done: int, total: int, note: str) -> None:
        """`done` of `total` stages are."""
        with self.lock:
            if done < total and time.monotonic() < self.next:
                return
            self.next = time.monotonic() + UPDATE_S
            percent, text = 100.0 * done / max(1, total), f"{done} of {total} stages {note}".strip()
            if self.artifact is None:
                self.artifact = cast(UUID, create_progress_artifact(percent, key=self.key, description=text))
            else:
                update_progress_artifact(self.artifact, percent, description=text)
