"""`cat3d run` and `cat3d demo`: make the jobs, see what is missing, run the flow with one server, write the report."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.markup import escape

from flows.generation.imported import samples
from flows.generation.opening import opening
from flows.jobs.job import Job
from flows.jobs.request import Request, make_request
from flows.names import shown
from flows.pipeline.expected import expected
from flows.pipeline.keys import Step, pending
from flows.pipeline.working_size import with_working_size
from flows.progress import console

DEMO_SOURCE = "procedural:co3d/4?views=16&width=96&height=96"


def run_command(request: Request) -> list[Job]:
    """Do everything that is not done yet for one scene and its splits. Raises InputError, ConfigError and others."""
    started, out = time.monotonic(), request.out
    with console.status(f"Reading {escape(shown(request.source))}"):
        jobs = with_working_size(request.jobs())
        capture = jobs[0].capture()
        todo = {job.run: pending(job) for job in jobs}
    stored = f", stored as {capture.scene_id}" if capture.title != capture.scene_id else ""
    console.print(f"{capture.title}: {len(capture)} views ({capture.dataset}{stored})", markup=False)
    for sentence in dict.fromkeys(text for job in jobs for text in to_say(job, todo[job.run])):
        console.print(sentence)
    for job in jobs:
        steps = todo[job.run]
        if steps:
            console.print(f"  {job.run}: to do: " + ", ".join(f"{s.stage} ({s.why})" for s in steps), markup=False)
        else:
            console.print(f"  {job.run}: every stage is done already; nothing to do.")
    if sentence := expected([(job, todo[job.run]) for job in jobs]):
        console.print(sentence)
    if any(todo.values()):
        from flows.pipeline.server import prefect_server

        with prefect_server(out / ".prefect"):
            from flows.pipeline.scene import scene_flow

            scene_flow(capture.scene_id, jobs)
    from flows.reporting.report import write_report
    from flows.reporting.summary import print_metrics

    report = write_report(out, only_if_changed=not any(todo.values()))
    print_metrics(out, capture.scene_id)
    console.print(f"Report: {report}  ({time.monotonic() - started:.0f} s)", markup=False)
    return jobs


def to_say(job: Job, steps: Sequence[Step]) -> list[str]:
    """What is to be said of the job's generator, where one of the steps that are to be done loads it."""
    loads = samples(job) and {"encode", "sample", "decode"} & {step.stage for step in steps}
    return opening(job) if loads else []


def demo_command(out: Path, smallest: bool) -> None:
    """A procedural scene: three views with and without generated ones, and all views, at a size for two cores."""
    given: dict[str, Any] = {"downscale": 3.0 if smallest else 1.0, "preset": "fast", "seed": 0}
    iterations = 60 if smallest else 400
    settings = [
        f"reconstruct.overrides={{iterations: {iterations}, warmup_iterations: {iterations // 10}}}",
        f"render.path_views={4 if smallest else 24}",
        f"plan.views={5 if smallest else 20}",
    ]
    from flows.pipeline.server import prefect_server

    # One server for both: Prefect's client keeps its connection to the first one for as long as the process lives.
    with prefect_server(out.resolve() / ".prefect"):
        for method, views in (("zipnerf", "3" if smallest else "3,all"), ("cat3d", "3")):
            run_command(make_request(DEMO_SOURCE, out, views, given | {"method": method}, settings=settings))
