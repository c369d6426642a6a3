"""The pictures of a store through ours, zarr itself and xarray, in one process: every view once, one after another.

`share_of_limit`: what their bytes on disk take as one large file beside the store, over the time it took.
"""

from __future__ import annotations

from flows.bench.peers.task import Row, Task, answer

# isort: split
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import xarray
import zarr

from flows.bench import limits
from schemas.scene_store import SceneStore

ARRAY = "image"


def measure(task: Task) -> list[Row]:
    """settings: store (a folder with captured pictures), repeats, threads. `error`: largest difference from ours."""
    path = Path(task.settings["store"])

    def ours() -> Iterator[Any]:
        section = SceneStore.open(path).captured
        yield from (section.read(ARRAY, [view])[0] for view in range(section.shape(ARRAY)[0]))

    def plain() -> Iterator[Any]:
        array = zarr.open_group(path, mode="r")[f"captured/{ARRAY}"]
        yield from (array[view] for view in range(array.shape[0]))  # type: ignore[union-attr, index, misc]

    def labelled() -> Iterator[Any]:
        array = xarray.open_zarr(path, group="captured", consolidated=False)[ARRAY]
        yield from (array[view].values for view in range(array.shape[0]))

    readers: dict[str, Callable[[], Iterator[Any]]] = {"cat3d": ours, "zarr": plain, "xarray": labelled}
    expected, rows = list(ours()), []
    stored = sum(f.stat().st_size for f in (path / "captured" / ARRAY).rglob("c.*"))
    for who, read in readers.items():
        seconds = min(_seconds(read) for _ in range(task.settings["repeats"]))
        wrong = max(float(np.abs(a.astype(int) - b).max()) for a, b in zip(expected, read(), strict=True))
        megabytes = sum(image.nbytes for image in expected) / 1e6
        rows.append(
            {"who": who, "setting": f"{len(expected)} views", "seconds": seconds / len(expected),
             "mb_per_s": megabytes / seconds, "error": wrong,
             **limits.file_columns(0, stored, seconds, path.parent)}
        )  # fmt: skip
    return rows


def _seconds(read: Callable[[], Iterator[Any]]) -> float:
    started = time.perf_counter()
    for image in read():
        np.asarray(image).sum()
    return time.perf_counter() - started


if __name__ == "__main__":
    answer(measure)
