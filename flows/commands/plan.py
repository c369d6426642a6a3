"""`cat3d plan`: read the photos, find the cameras, plan, and show the plan; nothing is sampled."""

from __future__ import annotations

from rich.markup import escape

from flows.generation.open import generator_spec
from flows.generation.plan import read_plan
from flows.jobs.job import Job
from flows.jobs.request import Request
from flows.media.plan_drawing import plan_table
from flows.names import shown
from flows.pipeline.runner import opened, run_missing
from flows.pipeline.working_size import with_working_size
from flows.progress import console
from schemas.scene_store import SceneStore


def plan_command(request: Request, rows: int = 24) -> list[Job]:
    """Plan one scene for its splits, store, draw and print the plans. `cat3d run --method cat3d` goes on from there.

    These stages are too short to need a server. Raises InputError, ConfigError and others.
    """
    with console.status(f"Reading {escape(shown(request.source))}"):
        jobs = with_working_size(request.jobs())
    if terms := generator_spec(jobs[0]).terms:
        console.print(terms)
    with opened(jobs[0]):
        for job in jobs:
            run_missing(job, until="plan")
    for job in jobs:
        show_plan(job, rows)
    return jobs


def show_plan(job: Job, rows: int) -> None:
    """Print the plan's groups, its reasons and where its picture is."""
    store = SceneStore.open(job.store_path)
    names = [str(name) for name in store.captured.read("name")]
    console.print(plan_table(read_plan(store.run(job.run).plan, len(names)), names, rows))
    console.print(f"Picture: {job.pictures / 'plan.png'}", markup=False)
