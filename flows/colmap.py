"""pycolmap, without the handlers its logging library puts on SIGTERM and others when it is imported.

They print a C++ stack trace and end the process before any `finally`; here the handlers that were there stay.
`from flows.colmap import pycolmap` instead of importing it.
"""

from __future__ import annotations

import contextlib
import faulthandler
import signal

_TAKEN = (signal.SIGTERM, signal.SIGABRT, signal.SIGSEGV, signal.SIGILL, signal.SIGFPE, signal.SIGBUS)
_before = {number: signal.getsignal(number) for number in _TAKEN}

import pycolmap  # noqa: E402

for _number, _handler in _before.items():
    with contextlib.suppress(ValueError, TypeError):  # ValueError: not in the main thread, which handles signals
        signal.signal(_number, _handler)
if faulthandler.is_enabled():
    faulthandler.enable()

__all__ = ["pycolmap"]
