"""pycolmap, without the handler its logging library puts on SIGTERM when it is imported.

That one prints a C++ stack trace and ends the process before any `finally`; here the handler that was there stays.
`from flows.sfm.colmap import pycolmap` instead of importing it.
"""

from __future__ import annotations

import contextlib
import signal

_before = signal.getsignal(signal.SIGTERM)

import pycolmap  # noqa: E402

with contextlib.suppress(ValueError, TypeError):  # ValueError: not in the main thread, which handles signals
    signal.signal(signal.SIGTERM, _before)

__all__ = ["pycolmap"]
