"""`cat3d plan`: read the photos, find the cameras, plan, and show the plan; nothing is sampled."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from flows.commands.run import make_config
from flows.jobs.job import Job, Request
from flows.pipeline.runner import opened, run_missing
from flows.progress import console
from flows.reporting.plan_drawing import plan_table
from flows.stages.plan import plan_run
from schemas.scene_store import SceneStore


def plan_command(
    source: str,
    out: Path,
    views: Sequence[str],
    given: dict[str, Any],
    reader: str = "auto",
    image_folder: str | None = None,
    config_file: Path | None = None,
    settings: Sequence[str] = (),
    rows: int = 24,
) -> list[Job]:
    """Plan one scene for its splits, store, draw and print the plans. `cat3d run --method cat3d` goes on from there.

    These stages are too short to need a server. Raises InputError, ConfigError and others.
    """
    config = make_config(given | {"method": "cat3d"}, config_file, settings)
    with console.status(f"Reading {source}"):
        request = Request(source, out.resolve(), tuple(v.strip() for v in views), config, reader, image_folder)
        jobs = request.jobs()
    with opened(jobs[0]):
        for job in jobs:
            run_missing(job, until="plan")
    for job in jobs:
        show_plan(job, rows)
    return jobs


def show_plan(job: Job, rows: int) -> None:
    """Print the plan's groups, its reasons and where its picture is."""
    store = SceneStore.open(job.store_path)
    plan, train = plan_run(job, store, store.run(job.run))
    names = store.captured.read("name")
    console.print(plan_table(plan, [str(names[v]) for v in train], rows))
    console.print(f"Picture: {job.pictures / 'plan.png'}")
