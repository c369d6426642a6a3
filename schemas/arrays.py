"""Arrays on disk: dtype, chunks and codecs by kind, and reads and writes that don't lose or invent a view.

Every chunk ends in crc32c, because zarr without it reads flipped bytes as data. A chunk that is missing would read as
the fill value: here it is an error. So empty (all-zero) chunks are always written.
"""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import zarr
from numpy.typing import NDArray
from zarr.codecs import BloscCodec, Crc32cCodec

from schemas.documents import discard, read_metadata, write_metadata
from schemas.errors import MissingError, StoreError

#: Largest chunk of a `parameter` array (a hash grid has gigabytes; blosc and crc32c work on chunks in memory).
PARAMETER_CHUNK_BYTES = 64 * 2**20


#: Metadata that say more are not believed: a chunk is decoded in memory (blosc's own bound), and every one is a file.
MAX_CHUNK_BYTES, MAX_CHUNKS = 2**31 - 1, 10_000_000


@dataclass(frozen=True)
class Kind:
    """How one kind of array is stored: `per_view` means one chunk per index of the first axis."""

    per_view: bool
    shuffle: Literal["shuffle", "bitshuffle"] | None = None  # with blosc zstd; None is stored raw


KINDS = {
    "image": Kind(per_view=True, shuffle="bitshuffle"),
    "mask": Kind(per_view=True, shuffle="bitshuffle"),
    "latent": Kind(per_view=True),  # float16 noise doesn't compress
    "raymap": Kind(per_view=True, shuffle="shuffle"),
    "depth": Kind(per_view=True, shuffle="shuffle"),
    "key": Kind(per_view=True),
    "parameter": Kind(per_view=False),
    "small": Kind(per_view=False),  # one chunk, written whole by one writer
}


def _storage(shape: tuple[int, ...], dtype: str, kind: str) -> dict[str, Any]:
    """Keyword arguments of `zarr.create_array` for an array of this kind."""
    if kind not in KINDS:
        raise ValueError(f"{kind!r} is not a kind of array; the kinds are {', '.join(KINDS)}.")
    how = KINDS[kind]
    chunks = [max(1, n) for n in shape]
    if how.per_view:
        chunks[0] = 1
    elif kind == "parameter" and shape:
        row_bytes = max(1, int(np.prod(chunks[1:], dtype=np.int64))) * np.dtype(dtype).itemsize
        chunks[0] = min(chunks[0], max(1, PARAMETER_CHUNK_BYTES // row_bytes))
    compressors: list[Any] = [Crc32cCodec()]
    if how.shuffle is not None:
        level = 1 if how.shuffle == "bitshuffle" else 3
        compressors.insert(0, BloscCodec(cname="zstd", clevel=level, shuffle=how.shuffle))
    return {
        "shape": shape,
        "dtype": str if dtype == "str" else np.dtype(dtype),
        "chunks": tuple(chunks),
        "compressors": compressors,
        "filters": None,
        # One file a chunk beside zarr.json; the default separator would make a folder for every index of every axis.
        "chunk_key_encoding": {"name": "default", "separator": "."},
    }


def create(
    folder: Path, shape: tuple[int, ...], dtype: str, kind: str,
    names: Sequence[str] | None = None, attributes: Mapping[str, str] | None = None,
) -> None:  # fmt: skip
    """Make an array in `folder`. One of the same shape and storage is kept with its data, any other is replaced.

    names: of the dimensions. attributes: what is stored with the array, such as its unit.
    """
    memory: dict[str, Any] = {}
    zarr.create_array(memory, **_storage(shape, dtype, kind), dimension_names=names, attributes=dict(attributes or {}))
    wanted = json.loads(memory["zarr.json"].to_bytes())
    try:
        if read_metadata(folder) == wanted:
            return
    except StoreError:
        pass
    discard(folder)
    write_metadata(folder, wanted)


def open_array(folder: Path, writable: bool) -> zarr.Array:
    """The zarr array in `folder`. Raises MissingError or StoreError."""
    document = read_metadata(folder)
    if document["node_type"] != "array":
        raise StoreError(f"{folder} is a Zarr group, where an array was expected.")
    return _opened(folder, writable, json.dumps(document, sort_keys=True))


@functools.lru_cache(maxsize=256)
def _opened(folder: Path, writable: bool, document: str) -> zarr.Array:
    """The same, once for each `document` that its metadata have been: opening takes as long as reading a small view."""
    try:
        array = zarr.open_array(str(folder), mode="r+" if writable else "r", zarr_format=3)
    except FileNotFoundError:  # removed by a writer since its metadata was read
        raise MissingError(f"{folder} does not exist.") from None
    except (ValueError, LookupError, TypeError, ArithmeticError, AttributeError) as error:
        raise StoreError(f"{folder / 'zarr.json'} is damaged: {error}") from error
    if 0 in array.chunks:
        raise StoreError(f"{folder / 'zarr.json'} is damaged: it names chunks of {array.chunks} values.")
    if math.prod(array.chunks) * array.dtype.itemsize > MAX_CHUNK_BYTES or math.prod(array.cdata_shape) > MAX_CHUNKS:
        raise StoreError(f"{folder} has {array.shape} values in chunks of {array.chunks}, it says: none of ours has.")
    return array.with_config({"write_empty_chunks": True})  # not stored with the array, so set at every opening


def chunk_coordinates(array: zarr.Array) -> Iterable[tuple[int, ...]]:
    """Coordinates of every chunk in the array's grid."""
    if 0 in array.shape:
        return iter(())
    return np.ndindex(*(-(-n // c) for n, c in zip(array.shape, array.chunks, strict=True)))


def chunk_file(folder: Path, array: zarr.Array, chunk: tuple[int, ...]) -> Path:
    """The file that holds one chunk."""
    return folder / array.metadata.encode_chunk_key(chunk)


def read_chunk(folder: Path, array: zarr.Array, chunk: tuple[int, ...]) -> NDArray[Any]:
    """One chunk, checked. Raises MissingError where it was never written, StoreError where it is damaged."""
    if not chunk_file(folder, array, chunk).exists():
        raise MissingError(f"{_place(folder, array, chunk)} was never written: run the stage that makes it.")
    try:
        return np.asarray(array.blocks[chunk] if chunk else array[...])
    except (ValueError, RuntimeError, TypeError, EOFError) as error:  # what zarr's codecs raise, see the tests
        raise StoreError(
            f"{_place(folder, array, chunk)} is damaged on disk ({error}): run the stage that makes it again."
        ) from error
    except OSError as error:
        raise StoreError(f"{_place(folder, array, chunk)} can't be read: {error.strerror or error}.") from error


def read(folder: Path, views: Sequence[int] | None = None) -> NDArray[Any]:
    """The whole array, or the given indices of its first axis, every chunk checked."""
    array = open_array(folder, writable=False)
    if views is None:
        out = _room(folder, array, array.shape)
        for chunk in chunk_coordinates(array):
            region = tuple(slice(i * n, (i + 1) * n) for i, n in zip(chunk, array.chunks))
            out[region] = read_chunk(folder, array, chunk)
        return out
    rows = check_views(folder, views, array.shape)
    if array.chunks[0] != 1:
        return read(folder)[rows]
    out = _room(folder, array, (len(rows), *array.shape[1:]))
    for i, row in enumerate(_views(folder, array, rows.tolist())):
        if isinstance(row, StoreError):
            raise row
        out[i] = row
    return out


def _room(folder: Path, array: zarr.Array, shape: tuple[int, ...]) -> NDArray[Any]:
    """Memory for values of an array; the system gives it as it is filled."""
    try:
        return np.empty(shape, array.dtype)
    except (MemoryError, ValueError) as error:
        raise StoreError(f"{folder} has {shape} values, which memory does not hold ({error}).") from None


def read_views(folder: Path, views: Sequence[int]) -> Iterator[NDArray[Any] | StoreError]:
    """Views of an array that is stored view by view, one at a time; a StoreError in place of one that can't be read."""
    array = open_array(folder, writable=False)
    yield from _views(folder, array, check_views(folder, views, array.shape).tolist())


def _views(folder: Path, array: zarr.Array, rows: Sequence[int]) -> Iterator[NDArray[Any] | StoreError]:
    for row in rows:
        try:
            yield read_chunk(folder, array, (row,) + (0,) * (array.ndim - 1))[0]
        except StoreError as error:
            yield error


def write(folder: Path, values: NDArray[Any], views: Sequence[int] | None = None) -> None:
    """Write the whole array, or whole views of it; a view that was damaged is simply replaced.

    `values` may be of another float or integer type as long as nothing overflows.
    """
    array = open_array(folder, writable=True)
    if views is None:
        values = _fitting(folder, array, np.asarray(values), array.shape)
        if array.ndim == 0 or array.chunks[0] != 1:
            with _sentences(f"{folder}"):
                array[...] = values
            return
        views = range(array.shape[0])
    if not array.ndim or array.chunks[0] != 1:
        raise StoreError(f"{folder} isn't stored view by view, so it is written whole.")
    rows = check_views(folder, views, array.shape)
    if len(set(rows.tolist())) != len(rows):
        raise StoreError(f"The views {rows.tolist()} to write to {folder} name one view twice.")
    values = _fitting(folder, array, np.asarray(values), (len(rows), *array.shape[1:]))
    for row, value in zip(rows.tolist(), values, strict=True):
        with _sentences(f"view {row} of {folder}"):
            array[row] = value


def check_views(folder: Path, views: Sequence[int], shape: tuple[int, ...]) -> NDArray[np.int64]:
    """`views` as an index array. Raises StoreError for a view outside the array."""
    rows = np.asarray(views, np.int64).reshape(-1)
    if not shape:
        raise StoreError(f"{folder} is a single value: it has no views.")
    for row in rows.tolist():
        if not 0 <= row < shape[0]:
            raise StoreError(f"View {row} is outside {folder}, which has {shape[0]} views.")
    return rows


def _fitting(folder: Path, array: zarr.Array, values: NDArray[Any], shape: tuple[int, ...]) -> NDArray[Any]:
    if values.shape != shape:
        raise StoreError(f"{folder} takes values of shape {shape}, but these have the shape {values.shape}.")
    if array.dtype.kind in "TOU":
        return values.astype(array.dtype)
    if values.dtype == array.dtype:
        return values
    if not np.can_cast(values.dtype, array.dtype, "same_kind"):
        raise StoreError(f"{folder} holds {array.dtype}, but the values to write are {values.dtype}: convert them.")
    with np.errstate(over="ignore"):
        cast = values.astype(array.dtype)
    lost = (cast != values) if array.dtype.kind in "iub" else (np.isfinite(cast) != np.isfinite(values))
    if lost.any():
        raise StoreError(f"{folder} holds {array.dtype}, and {int(lost.sum())} of the values to write don't fit in it.")
    return cast


class _sentences:
    """Turns a failed write into a StoreError that names the place; what was complete before stays complete."""

    def __init__(self, place: str) -> None:
        self.place = place

    def __enter__(self) -> None: ...

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if isinstance(error, OSError):
            raise StoreError(
                f"Writing {self.place} failed: {error.strerror or error}. What was stored before is still good; "
                "put that right (space, permissions) and run again."
            ) from error


def _place(folder: Path, array: zarr.Array, chunk: tuple[int, ...]) -> str:
    if array.ndim and array.chunks[0] == 1 and not any(chunk[1:]):
        return f"View {chunk[0]} of {folder}"
    return f"Chunk {list(chunk)} of {folder}"
