"""Sampling for many scenes at once: every worker always has a group, whichever scene it is of.

Done before the scenes' own flows, which then find their views there and only record the stages.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence

from flows.errors import describe
from flows.jobs import Job, expected_steps, pending
from flows.progress import console
from flows.sampling.fan_out import Totals, fan_out
from flows.sampling.work import Work
from flows.scene import ensure_store, execute_stage, prepare_run, writing
from flows.stages.sample import sample_work
from schemas.scene_store import SceneStore

PREPARATION = ("ingest", "poses", "plan", "encode")


def sample_ahead(jobs: Sequence[Job]) -> Totals:
    """Prepare the jobs that are to be sampled, then sample them together, with the execution settings of the first.

    A job that can't be prepared is left out, with a sentence: its own flow will meet the error again and report it.
    """
    with contextlib.ExitStack() as stores:
        works = []
        for path in dict.fromkeys(job.store_path for job in jobs if job.config.method == "cat3d"):
            own = [job for job in jobs if job.store_path == path and job.config.method == "cat3d"]
            try:
                stores.enter_context(writing(path, own[0].scene_id))
                works += [work for job in own if (work := prepared(job)) is not None]
            except Exception as error:
                sentence = describe(error)
                if sentence is None:
                    raise
                console.print(f"{own[0].scene_id} is not sampled with the others: {sentence}")
        if not works:
            return Totals()
        return fan_out(works, works[0].job.config.execution, f"sample {len(works)} runs")


def prepared(job: Job) -> Work | None:
    """The job's groups to sample, after the stages before sampling; None where they are sampled already."""
    capture = job.capture()
    ensure_store(job, capture)
    prepare_run(job, capture)
    steps = expected_steps(job, capture)
    for step in pending(job, steps):
        if step.stage in PREPARATION:
            execute_stage(job, step)
    if not any(step.stage == "sample" for step in pending(job, steps)):
        return None
    return sample_work(job, SceneStore.open(job.store_path, "r+"), steps["sample"].key)
