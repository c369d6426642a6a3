"""How commands reach results: a folder of this machine as it is, one on object storage by its working copy."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

from flows.errors import InputError
from flows.object_storage.address import Address, address_of
from flows.progress import console

if TYPE_CHECKING:
    from flows.object_storage.mirror import Mirror

_OPEN: dict[Path, Mirror] = {}
_COPYING = threading.Lock()


@contextmanager
def results_at(path: Path, writes: bool = True) -> Iterator[Path]:
    """The folder (or store in one, where `writes` is off) on this machine's file systems that a path or an s3 address
    means. Where it is written on object storage, what is done is copied there at the end.

    Raises InputError for what is no such address and while another command writes there, WorkerError where the storage
    refuses.
    """
    address = address_of(path)
    if address is None:
        yield path
        return
    inside = PurePosixPath()
    if not writes and address.folder.suffix == ".zarr":
        address, inside = Address(address.bucket, address.folder.parent), PurePosixPath(address.folder.name)
    mirror = _mirror(address)
    if not writes:
        yield mirror.read() / inside
        return
    with mirror.writing() as folder:
        _OPEN[folder] = mirror
        try:
            console.print(f"{address}: worked on in {folder}", markup=False)
            yield folder
        finally:
            del _OPEN[folder]


def copy_out(folder: Path) -> None:
    """Copy what is done so far, where the folder is a working copy and copying takes little of the time."""
    mirror = _OPEN.get(folder)
    if mirror is not None and time.monotonic() >= mirror.next:
        with _COPYING:
            mirror.push()


def _mirror(address: Address) -> Mirror:
    try:
        from flows.object_storage.mirror import Mirror
    except ImportError as error:
        raise InputError(
            f"{address} needs a package that is missing ({error.name}): pip install 'cat3d[s3]'."
        ) from None
    return Mirror(address)
