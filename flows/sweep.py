"""`cat3d sweep`: scenes x splits x methods x seeds as one Prefect flow, fanned out over scenes."""

from __future__ import annotations

import json
import os
import string
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from prefect import flow, task
from prefect.cache_policies import NO_CACHE
from prefect.task_runners import ProcessPoolTaskRunner

from flows.errors import describe
from flows.jobs import Job, capture_digests, expected_steps, make_jobs, pending
from flows.progress import console
from flows.readers.base import InputError
from flows.scene import run_jobs
from schemas.config import SweepConfig, merged, parse_config
from schemas.errors import ConfigError


def sweep_jobs(config: SweepConfig, out: Path) -> tuple[list[list[Job]], list[str]]:
    """The jobs of each scene, and a sentence for each scene or split that can't be had (nothing stops the rest)."""
    scenes, problems = [], []
    for scene in config.scenes:
        try:
            source = string.Template(scene.source).substitute(os.environ)
        except KeyError as error:
            problems.append(f"{scene.source}: the environment variable {error.args[0]} is not set; set it to the data.")
            continue
        jobs: list[Job] = []
        try:
            for label, settings in config.methods.items():
                for seed in config.seeds:
                    document = merged(config.base, scene.settings, settings, {"seed": seed, "label": label})
                    run = parse_config(document, f"{config.name}: method {label}")
                    for split in config.splits:
                        try:
                            jobs += make_jobs(source, out, [split], run, scene.reader, scene.image_folder)[1]
                        except InputError as error:
                            if "has no split" not in str(error):
                                raise
                            problems.append(str(error))
        except InputError as error:
            problems.append(str(error))
            continue
        scenes.append(jobs)
    twice = [j.scene_id for jobs in scenes for j in jobs[:1]]
    if len(set(twice)) != len(twice):
        raise ConfigError(f"{config.name}: two scenes have the same name; give their folders different names.")
    return [jobs for jobs in scenes if jobs], list(dict.fromkeys(problems))


def open_jobs(jobs: list[Job]) -> list[Job]:
    """The jobs of one scene that are not complete."""
    capture = jobs[0].capture()
    digests = capture_digests(capture)
    return [job for job in jobs if pending(job, expected_steps(job, capture, digests))]


@task(cache_policy=NO_CACHE, task_run_name="{scene_id}")
def run_scene(scene_id: str, jobs: list[dict[str, Any]]) -> dict[str, str]:
    """All open jobs of one scene. A failure that a user can act on comes back as {run: sentence}."""
    problems = {}
    for document in jobs:
        job = Job.model_validate(document)
        try:
            run_jobs([job])
        except Exception as error:
            sentence = describe(error)
            if sentence is None:
                raise
            problems[job.run] = f"{scene_id} {job.run}: {sentence}"
        from flows.report import write_report

        write_report(job.out)  # partial results at once
    return problems


@flow(name="cat3d-sweep", validate_parameters=False)
def _sweep(scenes: list[list[dict[str, Any]]], workers: int) -> list[str]:
    """One task a scene. With one worker in this very thread, so that Ctrl-C and SIGTERM stop it at once."""
    calls: list[tuple[str, Callable[[], dict[str, str]]]] = []
    for jobs in scenes:
        scene_id = jobs[0]["scene_id"]
        if workers > 1:
            calls.append((scene_id, run_scene.submit(scene_id, jobs).result))
        else:
            calls.append((scene_id, partial(run_scene, scene_id, jobs)))
    problems: list[str] = []
    for scene_id, call in calls:
        try:
            problems += call().values()
        except Exception as error:
            problems.append(f"{scene_id}: failed with {type(error).__name__}: {error}")
    return problems


def run_sweep(config: SweepConfig, out: Path) -> list[str]:
    """Do what is missing of a sweep. Returns a sentence per failure; results of the others stand."""
    from flows.report import write_report
    from flows.sampling.ahead import sample_ahead
    from flows.server import prefect_server

    out = out.resolve()
    scenes, problems = sweep_jobs(config, out)
    todo = [todo for jobs in scenes if (todo := open_jobs(jobs))]
    total, left = sum(map(len, scenes)), sum(map(len, todo))
    console.print(f"{config.name}: {len(scenes)} scenes, {total} runs, of which {left} are to do.")
    out.mkdir(parents=True, exist_ok=True)
    (out / "sweep.json").write_text(json.dumps(config.model_dump(mode="json"), indent=1))
    if todo:
        runner: Any = ProcessPoolTaskRunner(config.workers)
        with prefect_server(out / ".prefect"):
            sample_ahead([job for jobs in todo for job in jobs])
            documents = [[job.model_dump(mode="json") for job in jobs] for jobs in todo]
            problems += _sweep.with_options(task_runner=runner)(documents, config.workers)
    page = write_report(out, only_if_changed=not todo)
    console.print(f"Report: {page}")
    return problems
