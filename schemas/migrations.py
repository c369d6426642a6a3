"""Migrations of a scene store from one schema version to the next.

Each is safe to be killed and run again: every step leaves what is already done alone, and the version is written last,
when all else is on the disk.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from schemas.documents import nodes, read_group, read_metadata, sync_tree, write_group, write_metadata
from schemas.errors import StoreError
from schemas.layout import SCENE_STAGES, SCHEMA_VERSION, describe


def _from_0(store: Path) -> None:
    """Version 0, the design's draft, held one run at the root and had no records: it becomes the run "default"."""
    run = store / "runs" / "default"
    for folder in (store / "captured", store / "latents", store / "runs", store / "stages", run, run / "stages"):
        if not (folder / "zarr.json").exists():
            write_group(folder, {})
    for name in ("plan", "generated", "field", "renders"):
        if (store / name / "zarr.json").exists():
            (store / name).rename(run / name)
        elif not (run / name / "zarr.json").exists():
            write_group(run / name, {})
    for stage in [path for path in (store / "stages").iterdir() if path.is_dir() and path.name not in SCENE_STAGES]:
        stage.rename(run / "stages" / stage.name)
    attributes = read_group(store)
    attributes.setdefault("dataset", "unknown")
    attributes.setdefault("provenance", {})
    similarity = attributes.pop("similarity", None)
    if similarity is not None:
        write_group(store / "captured", {**read_group(store / "captured"), "similarity": similarity})
    sync_tree(store)
    write_group(store, {**attributes, "schema_version": 1})


def _from_1(store: Path) -> None:
    """Version 1 had neither names of dimensions nor units. Metadata changes; chunks and records stay as they are."""
    for path, kind in nodes(store):
        if kind == "array":
            document = read_metadata(store / path)
            names, attributes = describe(path, tuple(document["shape"]))
            described = {**document, "attributes": {**document["attributes"], **attributes}, "dimension_names": names}
            if described != document:
                write_metadata(store / path, described)
    sync_tree(store)
    write_group(store, {**read_group(store), "schema_version": 2})


#: Version -> what brings a store of that version to the next.
MIGRATIONS: dict[int, Callable[[Path], None]] = {0: _from_0, 1: _from_1}


def migrate(store: Path) -> int:
    """Bring the store at `store` to the present schema, step by step; returns the version it had.

    Raises StoreError for a version newer than this code or one it has no way from.
    """
    first = version = int(read_group(store)["schema_version"])
    if version > SCHEMA_VERSION:
        raise StoreError(f"{store} has schema version {version}, newer than {SCHEMA_VERSION}: update cat3d.")
    while version < SCHEMA_VERSION:
        if version not in MIGRATIONS:
            raise StoreError(f"{store} has schema version {version}, from which no migration leads on: make it again.")
        MIGRATIONS[version](store)
        version += 1
    return first
