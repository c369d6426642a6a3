"""Dataset readers: every layout becomes one `Capture` (see `base`)."""

from flows.readers.base import READERS, Capture, InputError, read_capture

__all__ = ["READERS", "Capture", "InputError", "read_capture"]
