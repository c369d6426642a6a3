"""One array of a store: its storage, statistics and histogram, and a contact sheet of what can be looked at."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cat3d_core.view_selection import evenly
from flows.errors import InputError
from flows.media.images import write_png
from flows.media.pictures import depth_picture, share_picture
from flows.reporting.inspect import array_row
from schemas import arrays
from schemas.documents import nodes, read_metadata
from schemas.errors import MissingError
from schemas.layout import array_spec
from schemas.scene_store import SceneStore

BINS = 12
#: Values of an array that are printed when there are no more of them.
FEW = 16
#: Views on a contact sheet at most, and the pixels of each side of one.
SHEET_VIEWS, CELL = 64, 128


def inspect_array(store: SceneStore, path: str) -> dict[str, Any]:
    """Everything about one array, as JSON types. `statistics` is None where the array holds text or nothing.

    Raises InputError where the store has no such array, StoreError where a chunk is damaged or was never written.
    """
    path = _known_array(store, path)
    row = array_row(store, path)
    if row is None:
        raise MissingError(f"{store.folder / path} was removed while it was read.")
    metadata, spec = read_metadata(store.folder / path), array_spec(path)
    values = arrays.read(store.folder / path)
    few = [str(v) for v in values.reshape(-1)] if values.size <= FEW else []
    return row | {
        "dimensions": list(metadata.get("dimension_names") or []),
        "meaning": spec.meaning if spec else "",
        "unit": spec.unit if spec else "",
        "statistics": statistics(values),
        "values": few,
    }


def statistics(values: NDArray[Any]) -> dict[str, Any] | None:
    """Count, values that are NaN or infinite, least, greatest, mean, standard deviation and a histogram of the finite.

    The sums are float64. histogram: (from, to, count) of `BINS` equal bins, one bin where all values are equal.
    """
    if values.dtype.kind not in "biuf" or not values.size:
        return None
    finite = values[np.isfinite(values)].astype(np.float64)
    out: dict[str, Any] = {"count": int(values.size), "not_finite": int(values.size - finite.size)}
    if not finite.size:
        return out
    low, high = float(finite.min()), float(finite.max())
    counts, edges = np.histogram(finite, BINS if high > low else 1, (low, high) if high > low else (low, low + 1))
    edges[-1] = high
    rows = [[float(a), float(b), int(n)] for a, b, n in zip(edges[:-1], edges[1:], counts)]
    mean, deviation = float(finite.mean()), float(finite.std())
    return out | {"least": low, "greatest": high, "mean": mean, "deviation": deviation, "histogram": rows}


def contact_sheet(store: SceneStore, path: str, target: Path) -> None:
    """Write a PNG of an array's views side by side: images as they are, depth in colours, latents by three channels.

    Raises InputError for an array that is no picture.
    """
    name = _known_array(store, path)
    spec, shape = array_spec(name), arrays.open_array(store.folder / name, writable=False).shape
    kind = spec.kind if spec else ""
    if kind not in ("image", "mask", "depth", "latent") or not shape[0]:
        pictures = [s for s, node in nodes(store.folder) if node == "array" and _is_picture(s)]
        raise InputError(f"{path} holds no pictures; those that do: {', '.join(pictures) or 'none yet'}.")
    views = evenly(shape[0], SHEET_VIEWS)
    empty = np.zeros((CELL, CELL, 3), np.uint8)  # what was never written is black
    read = arrays.read_views(store.folder / name, views)
    if spec is not None and kind == "depth" and spec.unit != "scene unit":
        kind = "share"
    cells = [_cell(value, kind) if isinstance(value, np.ndarray) else empty for value in read]
    columns = math.ceil(math.sqrt(len(cells)))
    height, width = (max(cell.shape[axis] for cell in cells) for axis in (0, 1))
    sheet = np.full((math.ceil(len(cells) / columns) * (height + 2), columns * (width + 2), 3), 255, np.uint8)
    for i, cell in enumerate(cells):
        top, left = i // columns * (height + 2), i % columns * (width + 2)
        sheet[top : top + cell.shape[0], left : left + cell.shape[1]] = cell
    write_png(target, sheet)


def _cell(value: NDArray[Any], kind: str) -> NDArray[np.uint8]:
    """One view as an (h, w, 3) uint8 picture, small ones enlarged and large ones thinned to about `CELL` pixels."""
    if kind == "depth":
        picture = depth_picture(value.astype(np.float32))
    elif kind == "share":
        picture = share_picture(value)
    elif kind == "latent":
        channels = value[:3].astype(np.float32)
        low, high = np.quantile(channels, [0.01, 0.99])
        picture = (np.clip((channels - low) / max(high - low, 1e-6), 0, 1) * 255).astype(np.uint8).transpose(1, 2, 0)
    else:
        picture = value if value.ndim == 3 else np.repeat(value[..., None], 3, 2)
    longest = max(picture.shape[:2])
    if longest > CELL:
        step = math.ceil(longest / CELL)
        return picture[::step, ::step]
    times = max(1, CELL // longest)
    return picture.repeat(times, 0).repeat(times, 1)


def _is_picture(path: str) -> bool:
    spec = array_spec(path)
    return spec is not None and spec.kind in ("image", "mask", "depth", "latent")


def _known_array(store: SceneStore, path: str) -> str:
    """The path if the store has that array. Raises InputError with what comes close."""
    path = path.strip("/")
    known = [name for name, kind in nodes(store.folder) if kind == "array"]
    if path in known:
        return path
    close = [name for name in known if name.startswith(f"{path}/")] or [n for n in known if n.endswith(f"/{path}")]
    listed = ", ".join((close or known)[:12]) or "none yet"
    raise InputError(f"{store.folder} has no array {path!r}; {'those near it' if close else 'its arrays'}: {listed}.")
