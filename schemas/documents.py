"""JSON documents of a store: plain values only, written so that a reader never sees half a file.

Metadata (`zarr.json`) is written here and not by zarr-python, because zarr writes the bare token NaN (not JSON) and has
no checksum, so that one flipped bit makes 2 views of 3. The checksum is the attribute `SEAL`, over everything else in
the document. Groups and records of completion are synced, and a stage's data before its record; what else a
power cut can leave half-written is found by checksums and made again.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import math
import os
import re
import shutil
import uuid
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel

from schemas.errors import MissingError, StoreError

#: Name of the attribute that holds a document's checksum.
SEAL = "document_sha256"
#: What may name a file or a group in a store.
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")
#: Entries that a `zarr.json` may have.
KEYS = {
    "zarr_format",
    "node_type",
    "attributes",
    "consolidated_metadata",
    "shape",
    "data_type",
    "chunk_grid",
    "chunk_key_encoding",
    "fill_value",
    "codecs",
    "storage_transformers",
    "dimension_names",
}


def checked_name(name: str) -> str:
    """`name` if it can be the name of a file in a store, so that no path leads out of it. Raises StoreError."""
    if not NAME.fullmatch(name):
        raise StoreError(f"{name!r} can't be a name in a store: use at most 100 letters, digits, '.', '_' and '-'.")
    return name


def plain(value: Any, where: str = "value") -> Any:
    """`value` as JSON types: numpy, Path, tuple, dataclass and pydantic models are converted.

    Raises StoreError for NaN, infinity, keys that aren't text and types JSON has no word for; `where` names the place.
    """
    if value is None or isinstance(value, (bool, int, str)):
        return value
    if isinstance(value, float):
        if not math.isfinite(value):
            raise StoreError(f"{where} is {value}, which JSON can't hold: leave the entry out or store it as an array.")
        return float(value)
    if isinstance(value, np.generic):
        return plain(value.item(), where)
    if isinstance(value, np.ndarray):
        return plain(value.tolist(), where)
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, BaseModel):
        return plain(value.model_dump(), where)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return plain({f.name: getattr(value, f.name) for f in dataclasses.fields(value)}, where)
    if isinstance(value, Mapping):
        for key in value:
            if not isinstance(key, str):
                raise StoreError(f"{where} has the key {key!r}, but the keys of a stored document are text.")
        return {key: plain(item, f"{where}.{key}") for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item, f"{where}[{i}]") for i, item in enumerate(value)]
    raise StoreError(f"{where} is a {type(value).__name__}, which can't be stored as JSON.")


def write_bytes(path: Path, data: bytes, durable: bool = False) -> None:
    """Replace the file atomically, by a temporary in the same folder; `durable` waits until it survives a power cut."""
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}.partial")
    try:
        with temporary.open("wb") as file:
            file.write(data)
            if durable:
                file.flush()
                os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    if durable:
        sync_folder(path.parent)


def discard(folder: Path) -> bool:
    """Remove a folder, by way of a hidden `.partial`, so that no reader sees half of it. False if there was none."""
    trash = folder.with_name(f".{folder.name}.{uuid.uuid4().hex}.partial")
    try:
        folder.rename(trash)
    except FileNotFoundError:
        return False
    sync_folder(folder.parent)  # else a power cut could bring it back, a record without its data
    shutil.rmtree(trash)
    return True


def leftovers(root: Path) -> list[Path]:
    """Temporary files and folders (`*.partial`) below `root`, sorted: being written now, or left by a killed writer."""
    found = []
    for folder, folders, files in os.walk(root):  # which passes over what vanishes meanwhile
        found += [Path(folder, name) for name in (*folders, *files) if name.endswith(".partial")]
        folders[:] = [name for name in folders if not name.endswith(".partial")]
    return sorted(found)


def listing(folder: Path) -> list[str]:
    """Names in a folder, none if a writer has removed it meanwhile."""
    try:
        return os.listdir(folder)
    except FileNotFoundError:
        return []


def nodes(root: Path, path: str = "") -> Iterator[tuple[str, str]]:
    """(path, "array" | "group" | "damaged") of everything below a group, sorted; hidden names are passed over."""
    for name in sorted(listing(root / path)):
        if name.startswith(".") or not (root / path / name).is_dir():
            continue
        child = f"{path}/{name}" if path else name
        try:
            kind = read_metadata(root / child)["node_type"]
        except MissingError:
            if not (root / child).exists():
                continue
            kind = "damaged"
        except StoreError:
            kind = "damaged"
        yield child, kind
        if kind == "group":
            yield from nodes(root, child)


def sync_folder(folder: Path) -> None:
    """Make renames in `folder`, or the content of a file, survive a power cut."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def sync_tree(root: Path, since_s: float = 0.0) -> None:
    """Make every file and folder below `root` that changed since a time (as time.time() gives it) survive a power cut.
    What goes away meanwhile is passed over."""
    for folder, _, files in os.walk(root):
        for path in (*(Path(folder, name) for name in files), Path(folder)):
            with contextlib.suppress(FileNotFoundError):
                if path.stat().st_mtime >= since_s:
                    sync_folder(path)


def write_metadata(folder: Path, document: Mapping[str, Any], durable: bool = False) -> None:
    """Write the `zarr.json` of a group or array, with its checksum."""
    sealed = {**document, "attributes": {**document["attributes"], SEAL: _seal(document)}}
    is_new = not folder.exists()
    folder.mkdir(parents=True, exist_ok=True)
    try:
        write_bytes(folder / "zarr.json", json.dumps(sealed, indent=2, allow_nan=False).encode(), durable)
    except BaseException:
        if is_new:  # a folder without a document is damage to whoever looks at the store
            with contextlib.suppress(OSError):
                folder.rmdir()
        raise


def write_group(folder: Path, attributes: Mapping[str, Any]) -> None:
    """Make `folder` a Zarr v3 group with these attributes, or replace the attributes of the one that is there. Durable,
    because without its groups nothing of a store can be read."""
    attributes = plain(attributes, f"attributes of {folder.name}")
    write_metadata(folder, {"zarr_format": 3, "node_type": "group", "attributes": attributes}, durable=True)


def read_metadata(folder: Path) -> dict[str, Any]:
    """The `zarr.json` of a group or array, checked and without its checksum. Raises MissingError or StoreError.

    A document without a checksum, as other programs write, is taken as it is.
    """
    path = folder / "zarr.json"
    try:
        document = json.loads(path.read_bytes(), parse_constant=_refuse_constant)
    except (FileNotFoundError, NotADirectoryError):
        raise MissingError(f"{path} does not exist.") from None
    except (ValueError, RecursionError) as error:
        raise StoreError(f"{path} is damaged: it isn't JSON ({error}).") from None
    if not isinstance(document, dict) or document.get("node_type") not in ("group", "array"):
        raise StoreError(f"{path} is damaged: it describes neither a Zarr group nor a Zarr array.")
    if unknown := set(document) - KEYS:  # a damaged key would hide what it held
        raise StoreError(f"{path} is damaged: it has the entries {sorted(unknown)}, which Zarr doesn't know.")
    attributes = document.setdefault("attributes", {})
    if not isinstance(attributes, dict):
        raise StoreError(f"{path} is damaged: its attributes are no mapping.")
    seal = attributes.pop(SEAL, None)
    if seal is not None and seal != _seal(document):
        raise StoreError(f"{path} is damaged, or was changed by another program: its checksum doesn't match.")
    return document


def read_group(folder: Path) -> dict[str, Any]:
    """Attributes of the group at `folder`. Raises MissingError or StoreError."""
    document = read_metadata(folder)
    if document["node_type"] != "group":
        raise StoreError(f"{folder} is a Zarr array, where a group was expected.")
    attributes: dict[str, Any] = document["attributes"]
    return attributes


def _seal(document: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(document, sort_keys=True).encode()).hexdigest()


def _refuse_constant(token: str) -> None:
    raise ValueError(f"the token {token} is not JSON")
