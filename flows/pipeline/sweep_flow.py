"""The flow of a sweep: all its runs at once, on one set of workers."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

from prefect import flow

from flows.errors import describe
from flows.jobs.job import Job
from flows.pipeline.scene import run_jobs
from flows.pipeline.side_by_side import Result
from flows.reporting.report import write_report

#: At most this share of a sweep's time goes into reports of what is there so far.
REPORT_SHARE = 0.05


@flow(name="cat3d-sweep", flow_run_name="{name}", validate_parameters=False)
def sweep_flow(name: str, jobs: Sequence[Job]) -> list[str]:
    """Do the jobs; a sentence for each that failed. A Prefect server must be running."""
    reports = _Reports()
    results = run_jobs(jobs, finished=lambda result: reports.write(result.job.out), same_threads=True)
    return [sentence for result in results if (sentence := _failure(result)) is not None]


def _failure(result: Result) -> str | None:
    if result.error is None:
        return None
    told = describe(result.error) or f"failed with {type(result.error).__name__}: {result.error}"
    return f"{result.job.scene_id} {result.job.run}: {told}"


class _Reports:
    """Partial results at once, as long as the page takes little of the time; the sweep's end writes it in any case."""

    def __init__(self) -> None:
        self.next = 0.0

    def write(self, out: Path) -> None:
        started = time.monotonic()
        if started < self.next:
            return
        write_report(out)
        ended = time.monotonic()
        self.next = ended + (ended - started) / REPORT_SHARE
