"""A group of a scene store: arrays by name, attributes, sections below it. All data goes in and out here."""

from __future__ import annotations

import shutil
import uuid
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from schemas import arrays
from schemas.documents import checked_name, discard, plain, read_group, sync_folder, write_group
from schemas.errors import MissingError, StoreError
from schemas.layout import array_spec, describe


class Section:
    """A group of the store: arrays by name, attributes, sections below it. `path` is relative to the store."""

    def __init__(self, root: Path, path: str, writable: bool) -> None:
        self.root, self.path, self.writable = root, path, writable
        self.folder = root / path if path else root

    def __repr__(self) -> str:
        return f"{type(self).__name__}({str(self.folder)!r}, {'r+' if self.writable else 'r'})"

    def __contains__(self, name: str) -> bool:
        return (self.folder / name / "zarr.json").exists()

    @property
    def attrs(self) -> dict[str, Any]:
        """The attributes as they are on disk now (a copy)."""
        return read_group(self.folder)

    def set_attrs(self, **values: Any) -> None:
        """Set attributes, keeping the others. One writer at a time; NaN and infinity are refused with StoreError."""
        self._check_writable()
        write_group(self.folder, {**self.attrs, **plain(values, f"attributes of {self.path or 'the store'}")})

    def section(self, name: str, create: bool = False) -> Section:
        """The section `name` below this one. Raises MissingError if it isn't there and `create` is False."""
        child = Section(self.root, join(self.path, checked_name(name)), self.writable)
        if name not in self:
            if not create:
                raise MissingError(f"{self.folder} has no {name!r} yet.")
            self._check_writable()
            make_tree(child.folder, {})
        return child

    def names(self) -> list[str]:
        """Names of the arrays and sections in this one, sorted."""
        return sorted(p.parent.name for p in self.folder.glob("*/zarr.json") if not p.parent.name.startswith("."))

    def shape(self, name: str) -> tuple[int, ...]:
        """Shape of an array, without reading it."""
        return tuple(arrays.open_array(self.folder / name, writable=False).shape)

    def create_array(self, name: str, shape: Sequence[int], dtype: str | None = None, kind: str | None = None) -> None:
        """Make room for an array. One of the same shape, type and storage is kept with its data, any other is replaced.

        dtype and kind come from the layout; an array the layout doesn't know needs both (`schemas/arrays.py:KINDS`).
        """
        self._check_writable()
        wanted = tuple(int(n) for n in shape)
        path = join(self.path, checked_name(name))
        spec = array_spec(path)
        if spec is not None:
            dtype, kind = dtype or spec.dtype, kind or spec.kind
        if dtype is None or kind is None:
            raise ValueError(f"The layout doesn't know {path!r}: say its dtype and kind.")
        if spec is not None and not spec.fits(wanted):
            dims = ", ".join(d.name if d.size is None else f"{d.name} = {d.size}" for d in spec.dims or ())
            raise StoreError(f"{path} has the dimensions ({dims}), but {wanted} was asked for.")
        arrays.create(self.folder / name, wanted, dtype, kind, *describe(path, wanted))

    def write(self, name: str, values: Any, dtype: str | None = None, kind: str | None = None) -> None:
        """Write a whole array, making it first."""
        values = np.asarray(values)
        if dtype is None and array_spec(join(self.path, name)) is None:
            dtype = "str" if values.dtype.kind in "OTU" else str(values.dtype)
            kind = kind or "small"
        self.create_array(name, values.shape, dtype, kind)
        arrays.write(self.folder / name, values)

    def write_views(self, name: str, values: NDArray[Any], views: Sequence[int]) -> None:
        """Write `values` (k, …) to k views of an array made by `create_array`. Safe beside writers of other views."""
        self._check_writable()
        arrays.write(self.folder / name, values, views)

    def read(self, name: str, views: Sequence[int] | None = None) -> NDArray[Any]:
        """An array, or some of its views, every chunk checked.

        Raises MissingError for what was never written and StoreError for what is damaged, naming array and view.
        """
        self._check_there(name)
        return arrays.read(self.folder / name, views)

    def remove(self, name: str) -> bool:
        """Remove an array or section; returns whether there was one."""
        self._check_writable()
        return discard(self.folder / checked_name(name))

    def write_images(self, name: str, images: Sequence[NDArray[np.uint8]], views: Sequence[int]) -> None:
        """Write images (h_i, w_i[, 3]) of any sizes to views of a padded array (V, H, W[, 3])."""
        shape = self.shape(name)[1:]
        padded = np.zeros((len(images), *shape), np.uint8)
        for i, image in enumerate(images):
            if image.shape[2:] != shape[2:] or image.shape[0] > shape[0] or image.shape[1] > shape[1]:
                raise StoreError(f"View {views[i]} has the shape {image.shape}; {self.folder / name} holds {shape}.")
            padded[i, : image.shape[0], : image.shape[1]] = image
        self.write_views(name, padded, views)

    def read_image(self, name: str, view: int, size: Sequence[int] | None = None) -> NDArray[Any]:
        """One view without its padding; `size` is [width, height], by default this section's `size` array at `view`."""
        width, height = self.read("size", [view])[0] if size is None else size
        return self.read(name, [view])[0, :height, :width]

    def mark_done(self, marker: str, keys: Sequence[str], views: Sequence[int]) -> None:
        """Record that views are complete, after their data is written: `keys` are content keys (64 hex digits)."""
        rows = np.array([np.frombuffer(bytes.fromhex(key), np.uint8) for key in keys], np.uint8).reshape(-1, 32)
        self.write_views(marker, rows, views)

    def mark_skipped(self, marker: str, views: Sequence[int]) -> None:
        """Record that views are left out on purpose."""
        self.write_views(marker, np.zeros((len(views), 32), np.uint8), views)

    def done(self, marker: str, keys: Sequence[str], data: Sequence[str] = ()) -> NDArray[np.bool_]:
        """Which of the first len(keys) views are complete with exactly these content keys, (n,) bool.

        A missing or damaged marker counts as not done. The arrays named in `data` are read too, so that a view whose
        chunk was lost or damaged on disk is found here and made again.
        """
        done = np.zeros(len(keys), bool)
        self._check_there(marker)
        for view, value in enumerate(arrays.read_views(self.folder / marker, range(len(keys)))):
            done[view] = not isinstance(value, StoreError) and value.tobytes().hex() == keys[view]
        for name in data:
            self._check_there(name)
            views = np.flatnonzero(done).tolist()
            for view, value in zip(views, arrays.read_views(self.folder / name, views)):
                done[view] = not isinstance(value, StoreError)
        return done

    def _check_there(self, name: str) -> None:
        if checked_name(name) not in self:
            spec = array_spec(join(self.path, name))
            remedy = f": run the stage {spec.stage!r}, which makes it" if spec and spec.stage else ""
            raise MissingError(f"{self.folder} has no array {name!r} yet{remedy}.")

    def _check_writable(self) -> None:
        if not self.writable:
            raise StoreError(f"{self.root} is open for reading only: open it with mode='r+' to write to it.")


def make_tree(folder: Path, attributes: Mapping[str, Any], groups: Sequence[str] = ()) -> bool:
    """Make a group with empty groups in it, all or nothing; False if another process has made it in the meantime."""
    temporary = folder.with_name(f".{folder.name}.{uuid.uuid4().hex}.partial")
    try:
        for name in groups:
            write_group(temporary / name, {})
        write_group(temporary, attributes)
        temporary.rename(folder)
        sync_folder(folder.parent)
    except OSError as error:
        shutil.rmtree(temporary, ignore_errors=True)
        if (folder / "zarr.json").exists():
            return False
        raise StoreError(f"{folder} can't be made: {error.strerror or error}.") from error
    return True


def join(path: str, name: str) -> str:
    """The path of `name` below `path`, both relative to the store."""
    return f"{path}/{name}" if path else name
