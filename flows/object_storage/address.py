"""Addresses of object storage, and where the working copy of such a folder is."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from cat3d_core.cpu_library import cache_folder
from flows.errors import InputError

_SCHEME = re.compile(r"([a-zA-Z][a-zA-Z0-9+]+):/+")


@dataclass(frozen=True)
class Address:
    """s3://BUCKET/FOLDER"""

    bucket: str
    folder: PurePosixPath

    def __str__(self) -> str:
        return f"s3://{self.bucket}/{self.folder}"

    def working_copy(self) -> Path:
        """Where commands work on it: below $CAT3D_WORK, or the cache folder. Workers on other machines need it at the
        same path."""
        root = Path(os.environ["CAT3D_WORK"]) if os.environ.get("CAT3D_WORK") else cache_folder() / "s3"
        return root.resolve() / self.bucket / self.folder


def address_of(path: Path) -> Address | None:
    """The address that a path given on the command line is (`pathlib` makes one slash of two); None for a plain path.
    Raises InputError for other addresses than s3://BUCKET/FOLDER."""
    found = _SCHEME.match(str(path))
    if found is None:
        return None
    rest = str(path)[found.end() :]
    if found[1].lower() != "s3":
        raise InputError(
            f"{found[1]}://{rest} is not on a file system, and of object storage only s3:// is supported: give a "
            "folder, or copy it when the command is done."
        )
    bucket, _, folder = rest.partition("/")
    parts = PurePosixPath(folder).parts
    if not bucket or not parts or any(part == ".." or part.startswith(".") for part in parts):
        raise InputError(f"s3://{rest} is not of the form s3://BUCKET/FOLDER, whose parts do not begin with a dot.")
    return Address(bucket, PurePosixPath(folder))
