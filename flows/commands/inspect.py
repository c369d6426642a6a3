"""`cat3d inspect`: print what a store holds; exit code 1 when something in it is damaged."""

from __future__ import annotations

import json
from pathlib import Path

import torch
import typer

from flows.errors import InputError
from flows.generation.plan import read_plan
from flows.jobs.access import read_cameras, views_with_role
from flows.jobs.job import Job
from flows.jobs.scene import Scene
from flows.pipeline.keys import expected_steps
from flows.progress import console
from flows.reporting.inspect import inspect_store
from flows.reporting.inspect_array import contact_sheet, inspect_array
from flows.reporting.inspect_text import as_text, one_array_text
from schemas.layout import SCENE_STAGES
from schemas.scene_store import SceneStore


def inspect_command(path: Path, array: str | None, verify: bool, as_json: bool, png: Path | None) -> None:
    """Print the inspection of a store, or of one of its arrays, as text or JSON; `png`: draw that array or plan."""
    if png is not None and array is None:
        raise InputError("--png draws one array or plan: name it after the store, such as captured/image.")
    if array is not None:
        _inspect_one(path, array, as_json, png)
        return
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


def _inspect_one(path: Path, array: str, as_json: bool, png: Path | None) -> None:
    """One array in full; with `png` its contact sheet, or the drawing of a plan."""
    store = SceneStore.open(path)
    parts = array.strip("/").split("/")
    if len(parts) == 3 and parts[0] == "runs" and parts[2] == "plan":
        if png is None:
            raise InputError(f"{array} is a whole plan: --png FILE draws it; name one of its arrays for its numbers.")
        png.write_bytes(drawn_plan(store, parts[1]))
    else:
        report = inspect_array(store, array)
        if as_json:
            print(json.dumps(report, indent=1))
        else:
            console.print(one_array_text(report))
        if png is not None:
            contact_sheet(store, array, png)
    if png is not None:
        console.print(f"Drawn: {png}")


def drawn_plan(store: SceneStore, name: str) -> bytes:
    """PNG of a run's stored plan with its training views. Raises MissingError where there is none, InputError for one
    that can't be drawn."""
    from flows.media.plan_drawing import draw_plan  # matplotlib: a second, which other inspections should not cost

    run = store.run(name)
    plan = read_plan(run.plan, store.captured.shape("size")[0])
    captured = read_cameras(store.captured, views_with_role(store, run, "train"))
    points = torch.from_numpy(store.captured.read("points")) if "points" in store.captured else None
    try:
        return draw_plan(captured, plan, points, f"{store.scene_id} {name}")
    except ValueError as error:  # a plan stored by an older program
        raise InputError(f"{store.folder} runs/{name}/plan: {error}") from None


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
            expected.setdefault((None if stage in SCENE_STAGES else name, stage), set()).update((step.key, step.older))
    return expected, ""
