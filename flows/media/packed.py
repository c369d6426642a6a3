"""Compressed files with a bound on what comes out: a few kilobytes can hold gigabytes of zeros."""

from __future__ import annotations

import gzip
import zipfile
import zlib
from pathlib import Path

from flows.errors import InputError

#: What one file may unpack to. CO3D's annotations of its largest category come to half of it.
MAX_BYTES = 2 * 2**30


def gunzip(path: Path) -> bytes:
    """The content of a gzip file. Raises InputError for another or a damaged file, or one of more than MAX_BYTES."""
    try:
        with gzip.open(path) as file:
            content = file.read(MAX_BYTES + 1)
    except (OSError, EOFError, zlib.error) as error:
        raise InputError(f"{path} is not a gzip file, or damaged ({error}); download it again.") from None
    if len(content) > MAX_BYTES:
        raise InputError(f"{path} unpacks to more than {_gigabytes(MAX_BYTES)}, which no file of its kind does.")
    return content


def check_zip(path: Path) -> None:
    """Raises InputError where the members of a zip file come to more than MAX_BYTES; what is no zip file passes."""
    if not zipfile.is_zipfile(path):
        return
    with zipfile.ZipFile(path) as archive:
        total = sum(member.file_size for member in archive.infolist())
    if total > MAX_BYTES:
        raise InputError(f"{path} unpacks to {_gigabytes(total)}, more than the bound of {_gigabytes(MAX_BYTES)}.")


def _gigabytes(size: int) -> str:
    return f"{size / 2**30:.1f} GB"
