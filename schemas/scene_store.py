"""The scene store: one Zarr v3 directory per scene, see `schemas/layout.py` for what it holds.

Written by many processes at once under one rule: a view is a chunk and has one writer. Data first, then its content key
(per view) or its record (per stage); only those say what is there.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from schemas import migrations
from schemas.documents import checked_name, leftovers, read_metadata
from schemas.errors import MissingError, StoreError
from schemas.layout import FORMAT, OLDEST_READABLE, SCENE_STAGES, SCHEMA_VERSION
from schemas.section import Section, make_tree
from schemas.stages import StageRecord, read_record, remove_record, write_record

GROUPS = ("captured", "latents", "runs", "stages")
RUN_GROUPS = ("plan", "generated", "field", "renders", "stages")


class Run(Section):
    """One run of a scene: a split and a method. Attributes: its configuration."""

    @property
    def name(self) -> str:
        return self.path.split("/")[-1]

    @property
    def plan(self) -> Section:
        return self.section("plan")

    @property
    def generated(self) -> Section:
        return self.section("generated")

    @property
    def field(self) -> Section:
        return self.section("field")

    def renders(self, kind: str) -> Section:
        """Renders of one kind, such as "test" or "path"; made on first use where the store is open for writing."""
        return self.section("renders").section(kind, create=self.writable)


class SceneStore(Section):
    """A scene's store, opened by `SceneStore.open` or made by `SceneStore.create`."""

    @classmethod
    def create(cls, path: str | Path, scene_id: str, dataset: str, provenance: Mapping[str, Any]) -> SceneStore:
        """Make an empty store, complete or not at all. Raises StoreError if there is something at `path` already."""
        path = Path(path)
        attributes = {
            "format": FORMAT,
            "schema_version": SCHEMA_VERSION,
            "scene_id": checked_name(scene_id),
            "dataset": dataset,
            "provenance": provenance,
        }
        empty = not path.exists() or (path.is_dir() and not any(path.iterdir()))
        if not empty or not make_tree(path, attributes, GROUPS):
            raise StoreError(f"{path} exists already: open it, or choose another place for the new store.")
        return cls.open(path, "r+")

    @classmethod
    def open(cls, path: str | Path, mode: Literal["r", "r+"] = "r") -> SceneStore:
        """Open a store. mode "r+" allows writing, and brings a store of an older schema up to date.

        Raises MissingError if nothing is there; StoreError for a folder that is no store, a foreign Zarr, a damaged or
        half-written store, and one of a newer schema.
        """
        path = Path(path)
        if mode not in ("r", "r+"):
            raise ValueError(f"The mode of a store is 'r' or 'r+', not {mode!r}.")
        attributes = _root_attributes(path)
        version = attributes.get("schema_version")
        if not isinstance(version, int) or isinstance(version, bool) or version < 0:
            raise StoreError(f"{path} is damaged: its schema_version is {version!r}. Make the store again.")
        if version > SCHEMA_VERSION:
            raise StoreError(
                f"{path} has schema version {version}, and this cat3d knows those up to {SCHEMA_VERSION}: update cat3d."
            )
        if version < OLDEST_READABLE and mode == "r":
            raise StoreError(
                f"{path} has the older schema version {version}: open it once for writing to bring it up to date."
            )
        if version < SCHEMA_VERSION and mode == "r+":
            migrations.migrate(path)
            attributes = _root_attributes(path)
        for name in ("scene_id", "dataset", "provenance"):
            if name not in attributes:
                raise StoreError(f"{path} is damaged: its attribute {name!r} is missing. Make the store again.")
        for name in GROUPS:
            if not (path / name / "zarr.json").exists():
                raise StoreError(f"{path} is half-written or damaged: its group {name!r} is missing. Make it again.")
        return cls(path, "", mode == "r+")

    @property
    def scene_id(self) -> str:
        return str(self.attrs["scene_id"])

    @property
    def dataset(self) -> str:
        return str(self.attrs["dataset"])

    @property
    def captured(self) -> Section:
        return self.section("captured")

    @property
    def latents(self) -> Section:
        return self.section("latents")

    def run(self, name: str, create: bool = False) -> Run:
        """The run `name`. Raises MissingError if it isn't there and `create` is False."""
        run = Run(self.root, f"runs/{checked_name(name)}", self.writable)
        if not (run.folder / "zarr.json").exists():
            if not create:
                known = ", ".join(self.runs()) or "none"
                raise MissingError(f"{self.folder} has no run {name!r} (its runs: {known}).")
            self._check_writable()
            make_tree(run.folder, {}, RUN_GROUPS)
        return run

    def runs(self) -> list[str]:
        """Names of the runs."""
        return Section(self.root, "runs", False).names()

    def record(self, stage: str, run: str | None = None) -> StageRecord | None:
        """The record of a completed stage, None if it isn't complete. `run` is ignored for stages done once a scene."""
        return read_record(self._stages(stage, run), stage)

    def complete(self, stage: str, record: StageRecord, run: str | None = None) -> None:
        """Record that a stage is complete. Call it after its data is written."""
        self._check_writable()
        if record.stage != stage:
            raise ValueError(f"The record is of the stage {record.stage!r}, not of {stage!r}.")
        write_record(self._stages(stage, run), record)

    def invalidate(self, stages: Sequence[str], run: str | None = None) -> list[str]:
        """Take back the records of a stage and of those after it, in the order they run; data stays. Returns what was
        taken back. Where the first is done once a scene, those of all runs are taken back.
        """
        self._check_writable()
        removed = []
        for name in reversed(stages):  # the last stage first: killed midway, what is left is consistent
            runs = [None] if name in SCENE_STAGES else (self.runs() if stages[0] in SCENE_STAGES else [run])
            for owner in runs:
                if remove_record(self._stages(name, owner), name):
                    removed.append(name if owner is None else f"{owner}/{name}")
        return removed[::-1]

    def forget(self, stage: str, run: str | None = None) -> bool:
        """Take back the record of this stage alone, before its data changes. Later stages whose keys cover the new
        result become stale by their keys; runs that don't read it keep theirs. Returns whether there was a record."""
        self._check_writable()
        return remove_record(self._stages(stage, run), stage)

    def sweep(self) -> list[str]:
        """Remove what killed writers left behind (`*.partial`). Only while nobody writes. Returns what was removed."""
        self._check_writable()
        found = leftovers(self.folder)
        for path in found:
            shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
        return [str(path.relative_to(self.folder)) for path in found]

    def _stages(self, stage: str, run: str | None) -> Path:
        if checked_name(stage) in SCENE_STAGES:
            return self.folder / "stages"
        if run is None:
            raise ValueError(f"The stage {stage!r} is done per run: say which run.")
        return self.run(run).folder / "stages"


def _root_attributes(path: Path) -> dict[str, Any]:
    """Attributes of the store's root, or a StoreError that says what else is there."""
    if not path.exists():
        raise MissingError(f"{path} does not exist: there is no scene store to open.")
    if not path.is_dir():
        raise StoreError(f"{path} is a file; a scene store is a folder.")
    if not (path / "zarr.json").exists():
        if (path / ".zgroup").exists() or (path / ".zarray").exists():
            raise StoreError(f"{path} is a Zarr of format 2, not a cat3d scene store.")
        if (path / "captured" / "zarr.json").exists() or (path / "runs" / "zarr.json").exists():
            raise StoreError(f"{path} is half-written: its zarr.json is missing. Make the store again.")
        raise StoreError(f"{path} is not a Zarr store: it has no zarr.json.")
    document = read_metadata(path)
    attributes: dict[str, Any] = document["attributes"]
    if document["node_type"] != "group" or attributes.get("format") != FORMAT:
        raise StoreError(f"{path} is a Zarr {document['node_type']} of someone else, not a cat3d scene store.")
    return attributes


__all__ = ["MissingError", "Run", "SceneStore", "Section", "StageRecord", "StoreError"]
