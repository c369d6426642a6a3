"""Sampling for many scenes at once: every worker always has a group, whichever scene it is of.

Done before the scenes' own flows, which then find their views there and only record the stages.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator, Sequence

from flows.errors import describe
from flows.generation.imported import samples
from flows.jobs.job import Job
from flows.pipeline.keys import expected_steps, pending, stage
from flows.pipeline.runner import opened, run_missing, write_timing
from flows.progress import console
from flows.reporting.summary import SAMPLED_AHEAD
from flows.stages.sample import sample_work
from flows.workers.fan_out import Totals, fan_out
from flows.workers.work import Work
from schemas.scene_store import SceneStore
from schemas.stages import StageRecord, now


def sample_ahead(jobs: Sequence[Job]) -> Totals:
    """Prepare the jobs that are to be sampled, then sample them together, with the execution settings of the first.

    What fails here is said and left to the scene's own flow, which will meet the same error and report it.
    """
    generative = [job for job in jobs if samples(job)]
    with contextlib.ExitStack() as stores:
        works: list[Work] = []
        for path in dict.fromkeys(job.store_path for job in generative):
            own = [job for job in generative if job.store_path == path]
            with _left_to_its_flow(own[0].scene_id):
                stores.enter_context(opened(own[0]))
                works += prepared_scene(own)
        if works:
            with _left_to_its_flow(f"{len(works)} runs"):
                started_at, started = now(), time.monotonic()
                totals = fan_out(works, works[0].job.config.execution, f"sample {len(works)} runs")
                write_shares(works, started_at, time.monotonic() - started, totals)
                return totals
        return Totals()


def write_shares(works: Sequence[Work], started_at: str, seconds: float, totals: Totals) -> None:
    """A row of timings for each run: its share of the seconds, by its number of groups. Its own stage `sample`, which
    finds the views there, takes next to nothing."""
    groups = [sum(len(items) for items in work.passes) for work in works]
    for work, count in zip(works, groups):
        record = StageRecord(
            stage=SAMPLED_AHEAD, key=work.key, started_at=started_at, finished_at=now(),
            seconds=seconds * count / max(1, sum(groups)), work={"groups": count, "workers": totals.workers},
        )  # fmt: skip
        write_timing(work.job, record, totals.usage)


@contextlib.contextmanager
def _left_to_its_flow(what: str) -> Iterator[None]:
    try:
        yield
    except Exception as error:
        sentence = describe(error)
        if sentence is None:
            raise
        console.print(f"Sampling {what} together with others failed: {sentence}")


def prepared_scene(jobs: Sequence[Job]) -> list[Work]:
    """What is to be sampled of the jobs of a scene whose captured views are encoded as the first's. A scene keeps one
    encoding at a time: those with another model's encoder sample in their own flow, where they encode right before."""
    encoding = expected_steps(jobs[0])["encode"].key
    works = [prepared(job) for job in jobs if expected_steps(job)["encode"].key == encoding]
    return [work for work in works if work is not None]


def prepared(job: Job) -> Work | None:
    """The job's groups to sample, after the stages before sampling; None where they are sampled already, or chosen only
    while sampling."""
    for read in stage("sample").reads:
        run_missing(job, until=read)
    step = next((step for step in pending(job) if step.stage == "sample"), None)
    if step is None or job.config.skip.rounds:
        return None
    return sample_work(job, SceneStore.open(job.store_path, "r+"), step.key)
