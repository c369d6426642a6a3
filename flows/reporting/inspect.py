"""What `cat3d inspect STORE` shows: the tree, how complete each stage is, the cameras, what is stale, what is damaged.

`inspect_store` gives a dictionary for machines; `inspect_text.py` prints it for people. Reading only; a store may be
written meanwhile, and then what is seen is a moment of it.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flows.stages import STAGES
from schemas import arrays
from schemas.documents import nodes
from schemas.errors import MissingError, StoreError
from schemas.layout import markers
from schemas.scene_store import SceneStore, Section
from schemas.verify import Problem, orphans, run_of, verify


def inspect_store(
    path: str | Path, verify_chunks: bool = False, expected: Mapping[tuple[str | None, str], set[str]] | None = None
) -> dict[str, Any]:
    """Everything about a store, as JSON types. Raises StoreError if it can't be opened at all.

    `expected` maps (run or None, stage) to the content keys it may have now (of a stage that is done once a scene, one
    for each run): a complete stage with another key is stale, and so is every complete stage after it. With
    `verify_chunks` every chunk is read and its checksum compared; `problems` lists what was found, and `ok` says
    whether there was anything but leftovers.
    """
    store = SceneStore.open(path)
    attributes = store.attrs
    stages = stage_rows(store)
    stale = stale_stages(store, expected) if expected is not None else None
    for row in stages:
        row["stale_because"] = None if stale is None else stale.get((row["run"], row["stage"]))
    problems = list(verify(store) if verify_chunks else orphans(store.folder))
    listed = [array_row(store, node) for node, kind in nodes(store.folder) if kind == "array"]
    rows = [row for row in listed if row is not None]
    return {
        "path": str(path),
        **{name: attributes[name] for name in ("format", "schema_version", "scene_id", "dataset", "provenance")},
        "runs": store.runs(),
        "arrays": rows,
        "bytes": sum(row["bytes"] for row in rows),
        "bytes_stored": sum(row["bytes_stored"] for row in rows),
        "stages": stages,
        "cameras": {
            name or "captured": summary
            for name, section in _camera_sections(store)
            if (summary := camera_summary(section)) is not None
        },
        "verified": verify_chunks,
        "problems": [_problem_row(problem) for problem in problems],
        "ok": all(problem.kind == "orphan" for problem in problems),
    }


def array_row(store: SceneStore, path: str) -> dict[str, Any] | None:
    """Shape, storage and sizes of one array; None if it has been removed, a row with `error` if it is damaged."""
    folder = store.folder / path
    try:
        array = arrays.open_array(folder, writable=False)
    except MissingError:
        return None
    except StoreError as error:
        return {"path": path, "error": str(error), "bytes": 0, "bytes_stored": 0}
    wanted = {arrays.chunk_file(folder, array, chunk).name for chunk in arrays.chunk_coordinates(array)}
    try:
        sizes = [entry.stat().st_size for entry in os.scandir(folder) if entry.name in wanted]
    except FileNotFoundError:
        return None
    stored = sum(sizes)
    row_bytes = array.nbytes // max(1, len(wanted)) * len(sizes)  # of the chunks that are there
    return {
        "path": path,
        "shape": list(array.shape),
        "dtype": "str" if array.dtype.kind == "T" else str(array.dtype),
        "chunks": list(array.chunks),
        "codecs": [_codec(codec) for codec in array.compressors],
        "chunks_total": len(wanted),
        "chunks_stored": len(sizes),
        "bytes": int(array.nbytes),
        "bytes_stored": stored,
        "compression_ratio": round(row_bytes / stored, 3) if stored and array.dtype.kind != "T" else None,
    }


def stage_rows(store: SceneStore) -> list[dict[str, Any]]:
    """One row per stage of the scene and of each run: complete or not, its key and time, views done of all."""
    rows = []
    for run, stage in _all_stages(store):
        row: dict[str, Any] = {"run": run, "stage": stage, "complete": False}
        try:
            record = store.record(stage, run)
            if record is not None:
                row |= {"complete": True, **record.model_dump(include={"key", "finished_at", "seconds", "work"})}
                row["decisions"] = [decision.text for decision in record.decisions]
        except MissingError:
            continue  # the run was removed meanwhile
        except StoreError as error:
            row["error"] = str(error)
        views = _views_done(store, run, stage)
        if views is not None:
            row["views_done"], row["views_total"] = views
        rows.append(row)
    return rows


def stale_stages(
    store: SceneStore, expected: Mapping[tuple[str | None, str], set[str]]
) -> dict[tuple[str | None, str], str]:
    """Complete stages whose result is out of date, (run or None, stage) -> why."""
    stale: dict[tuple[str | None, str], str] = {}
    for run, stage in _all_stages(store):  # in the order they run
        try:
            record = store.record(stage, run)
        except StoreError:
            record = None
        if record is None:
            continue
        read = next(one.reads for one in STAGES if one.name == stage)
        inputs = [(owner, name) for name in read for owner in (None, run)]
        changed = [name for owner, name in inputs if (owner, name) in stale]
        if (run, stage) in expected and record.key not in expected[run, stage]:
            stale[run, stage] = "its inputs, configuration or code have changed"
        elif changed:
            stale[run, stage] = f"{' and '.join(changed)} before it is out of date"
    return stale


def camera_summary(section: Section) -> dict[str, Any] | None:
    """Number, sizes, focal lengths (px), fields of view (degrees) and placement (scene units) of a section's cameras.

    None where there are none yet; a summary with `error` where they can't be read.
    """
    try:
        intrinsics = section.read("intrinsics")
        world_from_camera = section.read("world_from_camera")
        size = section.read("size")
    except MissingError:
        return None
    except StoreError as error:
        return {"error": str(error)}
    if not len(intrinsics) == len(world_from_camera) == len(size):
        counts = (len(intrinsics), len(world_from_camera), len(size))
        return {"error": f"intrinsics, world_from_camera and size are of {counts} views: they are being written."}
    if len(world_from_camera) == 0:
        return {"count": 0}
    focal_px = intrinsics[:, [0, 1], [0, 1]]
    fov_degrees = np.degrees(2 * np.arctan(size / 2 / focal_px))
    centers = world_from_camera[:, :3, 3]
    distances = np.linalg.norm(centers[:, None] - centers[None], axis=-1)
    others = distances[~np.eye(len(centers), dtype=bool)].reshape(len(centers), -1)
    return {
        "count": len(centers),
        "sizes": {f"{w}x{h}": n for (w, h), n in Counter(map(tuple, size.tolist())).most_common()},
        "focal_px": _range(focal_px),
        "fov_degrees": {"horizontal": _range(fov_degrees[:, 0]), "vertical": _range(fov_degrees[:, 1])},
        "extent_min": centers.min(0).tolist(),
        "extent_max": centers.max(0).tolist(),
        "baseline_largest": float(distances.max()),
        "baseline_to_nearest": _range(others.min(1)) if others.size else None,
    }


def _camera_sections(store: SceneStore) -> list[tuple[str | None, Section]]:
    plans = [(f"{run}/plan", Section(store.root, f"runs/{run}/plan", False)) for run in store.runs()]
    return [(None, store.captured), *plans]


def _all_stages(store: SceneStore) -> list[tuple[str | None, str]]:
    scene: list[tuple[str | None, str]] = [(None, stage.name) for stage in STAGES if stage.per == "scene"]
    return scene + [(run, stage.name) for run in store.runs() for stage in STAGES if stage.per == "run"]


def _views_done(store: SceneStore, run: str | None, stage: str) -> tuple[int, int] | None:
    """(done, all) views of a stage that works view by view, None where nothing is known of it."""
    patterns = [pattern.replace("runs/*", f"runs/{run}", 1) for pattern in markers(stage)]
    done = total = 0
    for folder in sorted(path for pattern in patterns for path in store.folder.glob(pattern)):
        try:
            count = arrays.open_array(folder, writable=False).shape[0]
            rows = arrays.read_views(folder, range(count))
            done += sum(not isinstance(row, StoreError) and bool(row.any()) for row in rows)
        except StoreError:
            continue
        total += count
    return (done, total) if total else None


def _problem_row(problem: Problem) -> dict[str, Any]:
    chunk = None if problem.chunk is None else list(problem.chunk)
    run = run_of(problem.path)
    return {"kind": problem.kind, "path": problem.path, "run": run, "chunk": chunk, "message": problem.message}


def _codec(codec: Any) -> str:
    document = codec.to_dict()
    details = document.get("configuration", {})
    return f"{details['cname']}+{details['shuffle']}" if document["name"] == "blosc" else str(document["name"])


def _range(values: NDArray[Any]) -> list[float]:
    return [float(values.min()), float(values.max())]
