"""`cat3d reprocess`: find what is stale in an output folder, say why and what it will cost, redo only that.

A scene is redone in a clone of its store whose files are hard links (every object of a store is replaced by rename,
never changed in place), its metrics and pictures go into a folder beside it, and both take the old ones' place when all
stages of the scene are complete. Until then the old results stay as they were; a reprocessing that was killed goes on
where it was.
"""

from __future__ import annotations

import os
import shutil
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from rich.table import Table

from flows.errors import InputError
from flows.jobs.job import Job
from flows.jobs.scene import Scene
from flows.pipeline.costs import Costs
from flows.pipeline.keys import Step, downstream, expected_steps, pending
from flows.pipeline.side_by_side import Result
from flows.progress import console
from schemas.errors import StoreError
from schemas.layout import SCENE_STAGES
from schemas.scene_store import SceneStore

FILTERS = ("scene", "dataset", "method", "run", "seed")


class Stale:
    """The stale steps of one scene's runs: {run: (job, steps)}."""

    def __init__(self, store: Path, runs: dict[str, tuple[Job, list[Step]]]) -> None:
        self.store, self.runs = store, runs


def parse_where(conditions: Sequence[str]) -> dict[str, str]:
    """["scene=llff_*", ...] -> {"scene": "llff_*"}. Raises InputError for an unknown field."""
    out = {}
    for condition in conditions:
        name, equals, pattern = condition.partition("=")
        if not equals or name not in FILTERS:
            raise InputError(f"--where {condition}: write FIELD=PATTERN with FIELD one of {', '.join(FILTERS)}.")
        out[name] = pattern
    return out


def find_stale(
    out: Path, split: str | None = None, where: dict[str, str] | None = None, from_stage: str | None = None,
    changes: dict[str, Any] | None = None,
) -> tuple[list[Stale], list[str]]:  # fmt: skip
    """What is stale in the folder's stores, and a sentence for each scene whose source can't be read.

    split, where: only these runs. from_stage: this stage and all after it count as stale. changes: settings to apply to
    every run's remembered configuration first (a new model, another preset).
    """
    from fnmatch import fnmatchcase

    from schemas.settings import merged

    if not any(out.glob("*.zarr")):
        raise InputError(f"{out} holds no scene stores; give the --out folder of an earlier run or sweep.")
    found, problems = [], []
    for path in sorted(out.glob("*.zarr")):
        store = SceneStore.open(clone_path(path) if clone_path(path).exists() else path)
        runs: dict[str, tuple[Job, list[Step]]] = {}
        scenes: dict[Scene, Scene] = {}
        for name in store.runs():
            document = store.run(name).attrs.get("job")
            if document is None:
                continue
            if changes:
                document = document | {"config": merged(document["config"], changes)}
            job = Job.model_validate(document | {"out": str(out)})
            values = {"scene": job.scene_id, "dataset": job.dataset, "method": job.label, "run": name,
                      "seed": str(job.config.seed)}  # fmt: skip
            wanted = all(fnmatchcase(values[f], p) for f, p in (where or {}).items())
            if not wanted or (split is not None and job.config.split != split):
                continue
            try:
                job = job.sharing(scenes.setdefault(job.scene, job.scene))
                steps = expected_steps(job)
            except InputError as error:
                problems.append(f"{job.scene_id}: {error}")
                continue
            target = job.model_copy(update={"store": store.root})
            stale = pending(target, steps)
            if from_stage:
                asked = [s for s in downstream(from_stage) if s in steps]
                known = {s.stage for s in stale}
                stale += [replace(steps[s], why="asked for by --from") for s in asked if s not in known]
                stale.sort(key=lambda s: list(steps).index(s.stage))
            if stale:
                runs[name] = (job, stale)
        if runs or clone_path(path).exists():
            found.append(Stale(path, runs))
    return found, problems


def print_stale(found: list[Stale], out: Path) -> float:
    """Print the table of what will be redone, why, and the cost expected from earlier timings; the total in seconds."""
    costs = Costs(out)
    table = Table("scene", "run", "stage", "why", "expected (s)")
    total, shared = 0.0, set()
    for stale in found:
        for name, (job, steps) in stale.runs.items():
            for step in steps:
                once = (job.scene_id, step.stage) if step.stage in SCENE_STAGES else None
                if once in shared:
                    continue
                shared.add(once) if once else None
                cost = costs.seconds(job, step.stage)
                total += cost or 0.0
                table.add_row(job.scene_id, name, step.stage, step.why, "unknown" if cost is None else f"{cost:.1f}")
    console.print(table)
    console.print(f"Expected: {total:.0f} s in all, from earlier timings.")
    return total


def redo(found: list[Stale], from_stage: str | None = None) -> None:
    """Redo what is stale, each scene in a clone that replaces the store when it is complete. Raises the first error,
    when all else is done."""
    from flows.pipeline.scene import run_jobs

    jobs: list[Job] = []
    for stale in found:
        jobs += cloned_jobs(stale, from_stage)
    left = Counter(job.store_path for job in jobs)
    failed: dict[Path, Exception] = {}

    def finished(result: Result) -> None:
        clone = result.job.store_path
        left[clone] -= 1
        if result.error is not None:
            failed.setdefault(clone, result.error)
        elif not left[clone] and clone not in failed:
            put_in_place(clone)

    for stale in found:
        if clone_path(stale.store) not in left:  # of an earlier reprocessing, which was killed when all was done
            put_in_place(clone_path(stale.store))
    run_jobs(jobs, finished=finished, same_threads=len(jobs) > 1)
    for error in failed.values():
        raise error


def cloned_jobs(stale: Stale, from_stage: str | None) -> list[Job]:
    """The scene's jobs in a clone of its store, which is made where an earlier reprocessing left none."""
    clone = clone_path(stale.store)
    results = clone.with_name(f"{clone.name}-results")
    fresh = not clone.exists()
    if fresh:
        shutil.rmtree(results, ignore_errors=True)
        make_clone(stale.store, clone)
    jobs = [job.model_copy(update={"store": clone, "results": results}) for job, _ in stale.runs.values()]
    if from_stage and fresh:  # a clone that is there already had its records taken back before
        store = SceneStore.open(clone, "r+")
        for job in jobs:
            store.invalidate(downstream(from_stage), job.run)
    return jobs


def put_in_place(clone: Path) -> None:
    """The results of a scene that is complete take the old ones' place."""
    store = clone.with_name(f"{clone.name.removeprefix('.').removesuffix('.reprocess')}.zarr")
    publish(clone.with_name(f"{clone.name}-results"), store.parent)
    replace_store(store, clone)


def clone_path(store: Path) -> Path:
    """Where a scene is redone. Does not end in .zarr, so that nothing takes it for a result."""
    return store.with_name(f".{store.stem}.reprocess")


def make_clone(store: Path, clone: Path) -> None:
    """A copy of the tree whose files are hard links, complete or not at all. Raises StoreError where links fail."""
    part = clone.with_name(f"{clone.name}.partial")
    shutil.rmtree(part, ignore_errors=True)
    try:
        shutil.copytree(store, part, copy_function=os.link)
    except (OSError, shutil.Error) as error:
        shutil.rmtree(part, ignore_errors=True)
        raise StoreError(
            f"{store} can't be cloned for reprocessing ({error}); put the folder on a disk with hard links."
        ) from None
    part.rename(clone)


def publish(results: Path, out: Path) -> None:
    """Move the files of a finished scene to their places in the output folder; a kill in between is made good by doing
    it again."""
    for path in sorted(results.rglob("*")):
        if path.is_file():
            target = out / path.relative_to(results)
            target.parent.mkdir(parents=True, exist_ok=True)
            os.replace(path, target)
    shutil.rmtree(results, ignore_errors=True)


def replace_store(store: Path, clone: Path) -> None:
    """Put the clone in the store's place; at every moment one of the two is complete under a known name."""
    old = store.with_name(f".{store.stem}.replaced")
    shutil.rmtree(old, ignore_errors=True)
    store.rename(old)
    clone.rename(store)
    shutil.rmtree(old)


def reprocess_command(
    out: Path, split: str | None, from_stage: str | None, where: Sequence[str], settings: dict[str, Any], dry_run: bool
) -> list[str]:
    """Find, print and (unless `dry_run`) redo what is stale. Returns sentences about scenes that could not be read."""
    from flows.pipeline.server import prefect_server
    from flows.reporting.report import write_report

    if from_stage is not None:
        try:
            downstream(from_stage)
        except ValueError as error:
            raise InputError(f"--from: {error}") from None
    out = out.resolve()
    recover(out)
    found, problems = find_stale(out, split, parse_where(where), from_stage, settings)
    if not found:
        console.print("Nothing is stale; nothing to do.")
        return problems
    print_stale(found, out)
    if dry_run:
        return problems
    with prefect_server(out / ".prefect"):
        from prefect import Flow

        Flow(redo, name="cat3d-reprocess", validate_parameters=False)(found, from_stage)
    write_report(out)
    return problems


def recover(out: Path) -> None:
    """Finish a replacement that was killed between its two renames."""
    for old in out.glob(".*.replaced"):
        store = old.with_name(f"{old.name.removeprefix('.').removesuffix('.replaced')}.zarr")
        if store.exists():
            shutil.rmtree(old)
            continue
        clone = clone_path(store)
        (clone if clone.exists() else old).rename(store)
        shutil.rmtree(old, ignore_errors=True)
