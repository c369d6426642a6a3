"""JSON documents of a store: plain values only, written so that a reader never sees half a file.

Group metadata (`zarr.json`) is written here and not by zarr-python, for three reasons: zarr writes the bare token NaN
(not JSON), it updates attributes by read-modify-write, and it doesn't fsync, so that a record of completion could
outlive the process and not the machine.
"""

from __future__ import annotations

import dataclasses
import json
import math
import os
import uuid
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel

from schemas.errors import MissingError, StoreError


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


def write_bytes(path: Path, data: bytes) -> None:
    """Replace the file atomically and durably: temporary in the same folder, fsync, rename, fsync of the folder."""
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}.partial")
    try:
        with temporary.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    """Make renames in `folder` durable."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_group(folder: Path, attributes: Mapping[str, Any]) -> None:
    """Make `folder` a Zarr v3 group with these attributes, or replace the attributes of the one that is there."""
    document = {"zarr_format": 3, "node_type": "group", "attributes": plain(attributes, f"attributes of {folder.name}")}
    folder.mkdir(parents=True, exist_ok=True)
    write_bytes(folder / "zarr.json", json.dumps(document, indent=2, allow_nan=False).encode())


def read_metadata(folder: Path) -> dict[str, Any]:
    """The `zarr.json` of a group or array. Raises MissingError or StoreError."""
    path = folder / "zarr.json"
    try:
        document = json.loads(path.read_bytes(), parse_constant=_refuse_constant)
    except (FileNotFoundError, NotADirectoryError):
        raise MissingError(f"{path} does not exist.") from None
    except ValueError as error:
        raise StoreError(f"{path} is damaged: it isn't JSON ({error}).") from None
    if not isinstance(document, dict) or document.get("node_type") not in ("group", "array"):
        raise StoreError(f"{path} is damaged: it describes neither a Zarr group nor a Zarr array.")
    return document


def read_group(folder: Path) -> dict[str, Any]:
    """Attributes of the group at `folder`. Raises MissingError or StoreError."""
    document = read_metadata(folder)
    attributes = document.get("attributes", {})
    if document["node_type"] != "group" or not isinstance(attributes, dict):
        raise StoreError(f"{folder / 'zarr.json'} is damaged: a Zarr group with attributes was expected there.")
    return attributes


def _refuse_constant(token: str) -> None:
    raise ValueError(f"the token {token} is not JSON")
