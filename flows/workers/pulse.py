"""Signs of life of a worker that is at something long: a small file beside the store, changed every few seconds.

What a worker stores says what is done; where nothing is stored for long, as while a field is trained, this says that it
is being worked on, and how far it is. It works wherever the store's file system is seen, without a connection.
"""

from __future__ import annotations

import contextlib
import json
import threading
from pathlib import Path
from types import TracebackType

from flows.progress import latest_meter
from flows.workers.work import Sign
from schemas.documents import write_bytes

BEAT_S = 2.0


class Pulse:
    """While it is entered, `path` changes every BEAT_S; it is gone afterwards."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.over = threading.Event()
        self.thread = threading.Thread(target=self._beat, daemon=True)

    def __enter__(self) -> Pulse:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self.thread.start()
        return self

    def __exit__(
        self, _kind: type[BaseException] | None, _error: BaseException | None, _trace: TracebackType | None
    ) -> None:
        self.over.set()
        self.thread.join()
        self.path.unlink(missing_ok=True)

    def _beat(self) -> None:
        number = 0
        while True:
            number += 1
            meter = latest_meter()
            sign = Sign(number, meter.done, meter.total, meter.note) if meter else Sign(number, 0, 1, "")
            with contextlib.suppress(OSError):  # a full disk is the work's to report
                write_bytes(self.path, json.dumps(sign).encode())
            if self.over.wait(BEAT_S):
                return


def read_pulse(path: Path) -> Sign | None:
    """The last sign; None where there is none."""
    try:
        beat, done, total, note = json.loads(path.read_bytes())
    except (OSError, ValueError):
        return None
    return Sign(int(beat), int(done), int(total), str(note))
