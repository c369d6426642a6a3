"""The flow of a sweep, fanned out over scenes."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from prefect import flow, task
from prefect.cache_policies import NO_CACHE
from prefect.task_runners import ProcessPoolTaskRunner

from flows.errors import describe
from flows.jobs.job import Job
from flows.pipeline.ahead import sample_ahead
from flows.pipeline.scene import run_jobs
from flows.reporting.report import write_report

#: At most this share of a sweep's time goes into reports of what is there so far.
REPORT_SHARE = 0.05


def sweep_flow(scenes: list[list[Job]], workers: int) -> list[str]:
    """Do the jobs, a list for each scene; a sentence for each that failed. A Prefect server must be running."""
    sample_ahead([job for jobs in scenes for job in jobs])
    runner: Any = ProcessPoolTaskRunner(workers)
    sentences: list[str] = _sweep.with_options(task_runner=runner)(scenes, workers)
    return sentences


@flow(name="cat3d-sweep", validate_parameters=False)
def _sweep(scenes: list[list[Job]], workers: int) -> list[str]:
    """One task a scene. With one worker in this very thread, so that Ctrl-C and SIGTERM stop it at once."""
    calls: list[tuple[str, Callable[[], dict[str, str]]]] = []
    for jobs in scenes:
        scene_id = jobs[0].scene_id
        if workers > 1:  # another process reads the scene itself
            documents = [job.model_dump(mode="json") for job in jobs]
            calls.append((scene_id, run_scene.submit(scene_id, documents).result))
        else:
            calls.append((scene_id, partial(run_scene, scene_id, jobs)))
    problems: list[str] = []
    for scene_id, call in calls:
        try:
            problems += call().values()
        except Exception as error:
            problems.append(f"{scene_id}: failed with {type(error).__name__}: {error}")
    return problems


@task(cache_policy=NO_CACHE, task_run_name="{scene_id}")
def run_scene(scene_id: str, jobs: Sequence[Job | dict[str, Any]]) -> dict[str, str]:
    """All open jobs of one scene. A failure that a user can act on comes back as {run: sentence}."""
    problems = {}
    scene = Job.model_validate(jobs[0]).scene
    for document in jobs:
        job = Job.model_validate(document).sharing(scene)
        try:
            run_jobs([job])
        except Exception as error:
            sentence = describe(error)
            if sentence is None:
                raise
            problems[job.run] = f"{scene_id} {job.run}: {sentence}"
        _report.write(job.out)
    return problems


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


_report = _Reports()
