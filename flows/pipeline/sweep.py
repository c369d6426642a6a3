"""`cat3d sweep`: what a sweep consists of and what of it is to do. Its flow is in `flows/pipeline/sweep_flow.py`."""

from __future__ import annotations

import glob
import json
import os
import string
from pathlib import Path

from flows.errors import InputError
from flows.jobs.job import Job, SplitError
from flows.jobs.request import Request
from flows.jobs.scene import Scene
from flows.pipeline.keys import pending
from flows.pipeline.working_size import with_working_size
from flows.progress import console
from schemas.config import SceneSource, SweepConfig, parse_config
from schemas.documents import write_bytes
from schemas.errors import ConfigError
from schemas.settings import merged


def sweep_jobs(config: SweepConfig, out: Path) -> tuple[list[list[Job]], list[str]]:
    """The jobs of each scene, and a sentence for each scene or split that can't be had (nothing stops the rest)."""
    scenes: list[list[Job]] = []
    problems: list[str] = []
    for scene in config.scenes:
        try:
            sources = scene_folders(scene)
        except InputError as error:
            problems.append(str(error))
            continue
        for source in sources:
            scenes.append(scene_jobs(config, scene, source, out, problems))
    twice = [j.scene_id for jobs in scenes for j in jobs[:1]]
    if len(set(twice)) != len(twice):
        raise ConfigError(f"{config.name}: two scenes have the same name; give their folders different names.")
    return [jobs for jobs in scenes if jobs], list(dict.fromkeys(problems))


def scene_folders(scene: SceneSource) -> list[str]:
    """The source with its variables replaced; all folders it matches where it is a pattern (room/*). Raises InputError
    with where to get the data."""
    obtain = f" {scene.obtain}" if scene.obtain else ""
    try:
        source = string.Template(scene.source).substitute(os.environ)
    except KeyError as error:
        name = error.args[0]
        raise InputError(
            f"{scene.source}: set the environment variable {name} to the folder of the data.{obtain}"
        ) from None
    if not any(c in source for c in "*[") or source.startswith("procedural:"):
        return [source]
    folders = sorted(path for path in glob.glob(source) if Path(path).is_dir())
    if not folders:
        raise InputError(f"{source}: there are no such scenes.{obtain}")
    return folders


def scene_jobs(config: SweepConfig, scene: SceneSource, source: str, out: Path, problems: list[str]) -> list[Job]:
    """The jobs of one scene; what can't be had is added to `problems`."""
    jobs: list[Job] = []
    places: dict[Scene, Scene] = {}  # read once, however many jobs ask
    try:
        for label, settings in config.methods.items():
            for seed in config.seeds:
                document = merged(config.base, scene.settings, settings, {"seed": seed, "label": label})
                run = parse_config(document, f"{config.name}: method {label}")
                for split in config.splits:
                    request = Request(source, out, (split,), run, scene.reader, scene.image_folder)
                    try:
                        jobs += request.jobs(places.setdefault(place := request.scene(), place))
                    except SplitError as error:
                        problems.append(str(error))
    except InputError as error:
        problems.append(f"{error} {scene.obtain}".strip())
        return []
    return with_working_size(jobs) if jobs else []


def open_jobs(jobs: list[Job]) -> list[Job]:
    """The jobs of one scene that are not complete."""
    return [job for job in jobs if pending(job)]


def run_sweep(config: SweepConfig, out: Path) -> list[str]:
    """Do what is missing of a sweep. Returns a sentence per failure; results of the others stand."""
    from flows.reporting.report import PROBLEMS, SWEEP, write_report

    out = out.resolve()
    scenes, problems = sweep_jobs(config, out)
    todo = [todo for jobs in scenes if (todo := open_jobs(jobs))]
    total, left = sum(map(len, scenes)), sum(map(len, todo))
    console.print(f"{config.name}: {len(scenes)} scenes, {total} runs, of which {left} are to do.")
    out.mkdir(parents=True, exist_ok=True)
    write_bytes(out / SWEEP, json.dumps(config.model_dump(mode="json"), indent=1).encode())
    if todo:
        # Only here: importing Prefect would be half the time of a sweep in which nothing is to do.
        from flows.pipeline.server import prefect_server
        from flows.pipeline.sweep_flow import sweep_flow

        with prefect_server(out / ".prefect"):
            problems += sweep_flow(config.name, [job for jobs in todo for job in jobs])
    write_bytes(out / PROBLEMS, json.dumps(problems, indent=1).encode())
    page = write_report(out, only_if_changed=not todo)
    console.print(f"Report: {page}")
    return problems
