"""What is said when the disk under --out is full, whoever found out first: a stage, or Prefect's server."""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

from flows.errors import InputError, describe
from schemas.errors import ConfigError, StoreError

#: A disk with less free space than this is full: a database needs so much to write at all.
FULL_BYTES = 1_000_000


@contextlib.contextmanager
def naming_full_disk(folder: Path) -> Iterator[None]:
    """Turn any failure that a full disk under `folder` caused into a StoreError that names the disk."""
    try:
        yield
    except (InputError, ConfigError):
        raise
    except Exception as error:
        sentence = full_disk(folder, error)
        if sentence is None:
            raise
        raise StoreError(sentence) from error


def full_disk(folder: Path, error: BaseException) -> str | None:
    """The sentence, None where the disk is not full and the error is not that it was."""
    there = next(path for path in (folder, *folder.parents) if path.exists())
    usage = shutil.disk_usage(there)
    if usage.free >= FULL_BYTES and not _no_space(error):
        return None
    disk = next(path for path in (there.resolve(), *there.resolve().parents) if os.path.ismount(path))
    ours = isinstance(error, OSError | StoreError)  # what Prefect's server says of it hides the cause
    told = f" ({described})" if ours and (described := describe(error)) else ""
    return (
        f"The disk {disk}, on which {folder.parent} is, is full: {usage.free / 1e6:.1f} of {usage.total / 1e6:.0f} MB "
        f"are free{told}. Free space there, or choose an --out elsewhere, and run again: what is stored is kept."
    )


def _no_space(error: BaseException | None) -> bool:
    while error is not None:
        if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
            return True
        error = error.__cause__ or error.__context__
    return False
