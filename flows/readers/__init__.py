"""Dataset readers: every layout becomes one `Capture` (see `base`)."""

from flows.readers.base import READERS, Capture, read_capture

__all__ = ["READERS", "Capture", "read_capture"]
