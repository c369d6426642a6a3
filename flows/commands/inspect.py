"""`cat3d inspect`: print what a store holds; exit code 1 when something in it is damaged."""

from __future__ import annotations

import json
from pathlib import Path

import typer

from flows.errors import InputError
from flows.jobs.job import Job
from flows.jobs.scene import Scene
from flows.pipeline.keys import expected_steps
from flows.progress import console
from flows.reporting.inspect import as_text, inspect_store
from schemas.layout import SCENE_STAGES
from schemas.scene_store import SceneStore


def inspect_command(path: Path, verify: bool, as_json: bool) -> None:
    """Print the inspection of a store as text or JSON."""
    expected, note = expected_keys(path)
    report = inspect_store(path, verify_chunks=verify, expected=expected)
    if as_json:
        print(json.dumps(report | {"note": note}, indent=1))
    else:
        console.print(as_text(report))
        if note:
            console.print(f"[dim]{note}[/dim]")
    if not report["ok"]:
        raise typer.Exit(1)


def expected_keys(path: Path) -> tuple[dict[tuple[str | None, str], set[str]] | None, str]:
    """The content keys each stage of the scene and of each run may have now, from the jobs that the store remembers;
    and a remark where the source can't be read any more, so that nothing can be said about staleness."""
    store = SceneStore.open(path)
    expected: dict[tuple[str | None, str], set[str]] = {}
    scenes: dict[Scene, Scene] = {}
    for name in store.runs():
        document = store.run(name).attrs.get("job")
        if document is None:
            continue
        job = Job.model_validate(document)
        try:
            steps = expected_steps(job.sharing(scenes.setdefault(job.scene, job.scene)))
        except InputError as error:
            return None, f"Whether stages are stale is unknown, since the source can't be read: {error}"
        for stage, step in steps.items():
            expected.setdefault((None if stage in SCENE_STAGES else name, stage), set()).add(step.key)
    return expected, ""
