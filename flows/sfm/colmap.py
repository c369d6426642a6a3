"""pycolmap, without the handler its logging library puts on SIGTERM when it is imported.

That one prints a C++ stack trace and ends the process before any `finally`; here the handler that was there stays.
`from flows.sfm.colmap import pycolmap` instead of importing it. Where it isn't installed (it has no wheels for Linux on
ARM), whatever needs it says so; scenes with cameras in other files than COLMAP's do without.
"""

from __future__ import annotations

import contextlib
import signal
from typing import Any

from flows.errors import InputError


class _Missing:
    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        raise InputError(
            "This needs pycolmap, which is not installed (it has no wheels for Linux on ARM): build it from source, "
            "or give a scene with cameras, such as a transforms.json."
        )


_before = signal.getsignal(signal.SIGTERM)

try:
    import pycolmap
except ImportError:
    pycolmap = _Missing()  # type: ignore[assignment]

with contextlib.suppress(ValueError, TypeError):  # ValueError: not in the main thread, which handles signals
    signal.signal(signal.SIGTERM, _before)

__all__ = ["pycolmap"]
