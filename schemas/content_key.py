"""Content keys: a stage runs again only if the key of its inputs, configuration and code version has changed."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from collections.abc import Mapping
from enum import Enum
from pathlib import Path, PurePath
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel


def content_key(**parts: Any) -> str:
    """sha256 (64 hexadecimal digits) of the parts, the same in every process and on every machine.

    Values may be None, bool, int, float, str, bytes, Path, Enum, numpy scalars and arrays, lists, tuples, sets,
    mappings with text keys, dataclasses and pydantic models, nested. Floats count exactly (-0.0 differs from 0.0),
    types count (1, 1.0, True and "1" differ), the order of mappings and sets does not, and lists equal tuples.
    Arrays count by dtype, shape and bytes, byte order aside.

    Raises ValueError for NaN and infinite floats (no configuration means them) and for types it has no rule for.
    """
    tagged = [[name, _tagged(value, name)] for name, value in sorted(parts.items())]
    return hashlib.sha256(json.dumps(tagged, separators=(",", ":")).encode("ascii")).hexdigest()


def array_digest(array: NDArray[Any]) -> str:
    """sha256 (64 hexadecimal digits) of dtype, shape and the values' bytes in little-endian C order."""
    array = np.asarray(array)
    if array.dtype.kind in "OTUV":
        raise ValueError(f"An array of dtype {array.dtype} has no bytes of its own to digest: pass it as a list.")
    little = np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("<"))
    digest = hashlib.sha256(f"{little.dtype.str}{array.shape}".encode())
    digest.update(little.tobytes())
    return digest.hexdigest()


def file_sha256(path: Path) -> str:
    """sha256 of a file's bytes, hexadecimal."""
    with open(path, "rb") as f:
        return hashlib.file_digest(f, "sha256").hexdigest()


def _tagged(value: Any, where: str) -> list[Any]:
    """`value` as JSON in which every node says its type, so that no two different values meet."""
    if isinstance(value, Enum):
        return _tagged(value.value, where)
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, bool):
        return ["c", value]
    if isinstance(value, int):
        return ["i", str(value)]
    if isinstance(value, float):
        if not math.isfinite(value):
            raise ValueError(f"{where} is {value}: a content key is made of finite numbers only.")
        return ["f", value.hex()]
    if isinstance(value, str):
        return ["s", value]
    if isinstance(value, (bytes, bytearray, memoryview)):
        return ["b", hashlib.sha256(value).hexdigest()]
    if isinstance(value, PurePath):
        return ["p", value.as_posix()]
    if isinstance(value, np.ndarray):
        return _tagged(value.tolist(), where) if value.dtype.kind in "OTU" else ["a", array_digest(value)]
    if isinstance(value, BaseModel):
        return _tagged({name: getattr(value, name) for name in type(value).model_fields}, where)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return _tagged({f.name: getattr(value, f.name) for f in dataclasses.fields(value)}, where)
    if isinstance(value, Mapping):
        for key in value:
            if not isinstance(key, str):
                raise ValueError(f"{where} has the key {key!r}, but only text keys have a place in a content key.")
        return ["d", [[key, _tagged(value[key], f"{where}.{key}")] for key in sorted(value)]]
    if isinstance(value, (list, tuple)):
        return ["l", [_tagged(item, f"{where}[{i}]") for i, item in enumerate(value)]]
    if isinstance(value, (set, frozenset)):
        return ["t", sorted((_tagged(item, f"an item of {where}") for item in value), key=json.dumps)]
    raise ValueError(f"{where} is a {type(value).__name__}, for which content keys have no rule.")
