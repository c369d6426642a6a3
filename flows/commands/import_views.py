"""`cat3d import-views`: pictures that any other program made of a plan's views become the run's generated views."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

from flows.errors import InputError
from flows.exports.plan import open_plan
from flows.generation.imported import Imported, digest, find_views, imported_into, read_view
from flows.locks import writing
from flows.progress import console, meter
from schemas.scene_store import Run, SceneStore

_GO_ON = "The rest goes on with the same `cat3d run`, or with `cat3d reprocess {out}`."


def import_views_command(path: Path, folder: Path | None, run_name: str | None, note: str, partial: bool) -> None:
    """Check all pictures of `folder`, then store them; folder None: forget those that were imported before.

    Raises InputError for pictures that aren't the plan's, StoreError for a damaged store.
    """
    source = open_plan(path, run_name, "scene")
    name = source.run.name
    files = {} if folder is None else find_views(folder, source.plan.cameras, partial)
    with writing(source.store.root, source.store.scene_id):
        store = SceneStore.open(path, "r+")
        run = store.run(name)
        if folder is None:
            _forget(store, run)
            console.print(f"The views of {name} will be generated. {_GO_ON.format(out=path.parent)}")
            return
        record = store.record("plan", name)
        if record is None:
            raise InputError(f"The plan of {name} is being made again; wait for it, and export it once more.")
        found = Imported(str(folder.resolve()), note, digest(files), record.key, sorted(files))
        _start_over(store, run)
        width, height = source.plan.cameras.size[0].tolist()
        run.generated.create_array("image", (len(source.plan), height, width, 3))
        with meter(f"import {store.scene_id} {name}", len(files)) as progress:
            for view, file in files.items():
                run.generated.write_views("image", read_view(file), [view])
                progress.advance()
        run.generated.set_attrs(imported=asdict(found), terms="")
    console.print(f"{found} {_GO_ON.format(out=path.parent)}", markup=False)


def _forget(store: SceneStore, run: Run) -> None:
    if imported_into(run) is None:
        raise InputError(f"No views were imported into {run.name}; there is nothing to forget.")
    _start_over(store, run)


def _start_over(store: SceneStore, run: Run) -> None:
    """No generated view counts as done, whoever made it: records first, then what they stand for."""
    for stage in ("decode", "sample"):
        store.forget(stage, run.name)
    run.generated.set_attrs(imported=None)
    for marker in ("done_image", "done_latent", "image", "latent"):
        if marker in run.generated:
            run.generated.remove(marker)
