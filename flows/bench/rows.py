"""What all benchmarks share: rows, which of them are the defaults, and the scenes of a folder."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from flows.errors import InputError

Row = dict[str, Any]


class MissingError(InputError):
    """A benchmark lacks what it works on: data, a model or other programs that are not on this machine."""


def marked(rows: list[Row], default: Mapping[str, Any]) -> list[Row]:
    """The rows with `default`: whether a row has these values."""
    return [row | {"default": all(row.get(name) == value for name, value in default.items())} for row in rows]


def scenes_of(data: Path | None, names: list[str]) -> list[Path]:
    """Those of the named scenes that are in the folder of real scenes. Raises MissingError where there is none."""
    if data is None:
        raise MissingError("This benchmark works on real scenes with known cameras: give their folder as --data DIR.")
    found = [data / name for name in names if (data / name).is_dir()]
    if not found:
        raise MissingError(f"{data} holds none of the scenes {', '.join(names)}.")
    return found
