"""One writer at a time: a lock file beside what is written."""

from __future__ import annotations

import contextlib
import fcntl
import os
from collections.abc import Iterator
from pathlib import Path

from flows.errors import InputError


@contextlib.contextmanager
def writing(store_path: Path, scene_id: str) -> Iterator[None]:
    """Be the only command that writes this store; a kill frees the lock. Raises InputError while another one writes."""
    store_path.parent.mkdir(parents=True, exist_ok=True)
    lock = store_path.with_name(f".{scene_id}.lock")
    with open(lock, "a+") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            file.seek(0)
            raise InputError(
                f"Another cat3d command (process {file.read().strip() or 'unknown'}) is writing {store_path}; "
                "wait for it, or choose another --out."
            ) from None
        file.truncate(0)
        file.write(str(os.getpid()))
        file.flush()
        yield
