"""Finding damage in a scene store: every chunk is read, every file accounted for. Works while the store is written."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from zarr.codecs import Crc32cCodec

from schemas import arrays
from schemas.documents import SEAL, leftovers, listing, nodes, read_metadata
from schemas.errors import MissingError, StoreError
from schemas.layout import SCENE_STAGES, array_spec, done_path
from schemas.scene_store import SceneStore


@dataclass(frozen=True)
class Problem:
    """Something wrong: kind is corrupted, missing, orphan or unchecked; chunk is the coordinates in the chunk grid."""

    kind: str
    path: str
    message: str
    chunk: tuple[int, ...] | None = None


def verify(store: SceneStore) -> Iterator[Problem]:
    """Every problem in the store, as it is found."""
    for path, kind in nodes(store.folder):
        if kind == "array":
            yield from verify_array(store, path)
        elif kind == "damaged":
            yield _damaged(store.folder, path)
        elif path.split("/")[-2:-1] == ["stages"]:
            yield from _verify_record(store, path)
    yield from orphans(store.folder)


def verify_array(store: SceneStore, path: str) -> Iterator[Problem]:
    """Read every chunk of an array. One that isn't there is a problem if its stage or its view is marked as done."""
    folder = store.folder / path
    version = _version(folder)
    try:
        array = arrays.open_array(folder, writable=False)
    except MissingError:
        return
    except StoreError as error:
        yield Problem("corrupted", path, str(error))
        return
    if not any(isinstance(codec, Crc32cCodec) for codec in array.compressors) or SEAL not in array.attrs:
        yield Problem("unchecked", path, f"{folder} is stored without checksums: damage can't be seen.")
    expected = {"zarr.json"}
    found: list[Problem] = []
    for chunk in arrays.chunk_coordinates(array):
        file = arrays.chunk_file(folder, array, chunk)
        expected.add(file.name)
        try:
            arrays.read_chunk(folder, array, chunk)
        except MissingError as error:
            # Asked in this order, because a writer may be writing the view and then its mark at this moment.
            if _should_be_there(store, path, chunk) and not file.exists():
                found.append(Problem("missing", path, str(error), chunk))
        except StoreError as error:
            found.append(Problem("corrupted", path, str(error), chunk))
    for file in map(folder.joinpath, sorted(listing(folder))):
        if file.is_file() and file.name not in expected and not file.name.endswith(".partial"):
            found.append(Problem("orphan", f"{path}/{file.name}", f"{file} belongs to no chunk of the array."))
    if _version(folder) == version:  # else a writer has replaced the array meanwhile: what was read were two halves
        yield from found


def _version(folder: Path) -> tuple[int, int] | None:
    """What tells an array from another that takes its place."""
    try:
        status = (folder / "zarr.json").stat()
    except FileNotFoundError:
        return None
    return status.st_ino, status.st_mtime_ns


def orphans(root: Path) -> Iterator[Problem]:
    """Files and folders a killed writer left behind, or that one is writing at this moment."""
    for path in leftovers(root):
        relative = str(path.relative_to(root))
        yield Problem("orphan", relative, f"{path} was left by a writer that was killed, or is being written now.")


def _should_be_there(store: SceneStore, path: str, chunk: tuple[int, ...]) -> bool:
    """Whether the stage that writes the array is recorded complete, or the view itself is marked as done."""
    spec = array_spec(path)
    marker = done_path(path)
    if marker is not None and (store.folder / marker / "zarr.json").exists():
        try:
            return bool(arrays.read(store.folder / marker, [chunk[0]]).any())
        except MissingError:
            pass  # nothing is said about this view, so the stage's record decides
        except StoreError:
            return False  # reported as a problem of the marker
    if spec is None or spec.stage is None:
        return True
    try:
        return store.record(spec.stage, run_of(path) if spec.stage not in SCENE_STAGES else None) is not None
    except StoreError:
        return False  # reported as a problem of the record


def run_of(path: str) -> str | None:
    """The run that the array or section at `path` belongs to."""
    parts = path.split("/")
    return parts[1] if parts[0] == "runs" and len(parts) > 1 else None


def _verify_record(store: SceneStore, path: str) -> Iterator[Problem]:
    try:
        store.record(path.split("/")[-1], run_of(path))
    except ValueError as error:
        yield Problem("corrupted", path, str(error))


def _damaged(root: Path, path: str) -> Problem:
    try:
        read_metadata(root / path)
    except MissingError:
        return Problem("orphan", path, f"{root / path} has no zarr.json: half-written, or no part of the store.")
    except StoreError as error:
        return Problem("corrupted", path, str(error))
    return Problem("corrupted", path, f"{root / path} is damaged.")
