"""Progress of long work: rich bars on a terminal, a plain line now and then elsewhere (logs, CI, pipes)."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Iterator

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

console = Console(highlight=False)

PLAIN_INTERVAL_S = 15.0


class Meter:
    """Counts finished units of one piece of work. `note` is a short remark beside the bar (a loss, a view name)."""

    def __init__(self, label: str, total: int, progress: Progress | None, quiet: bool = False) -> None:
        self.label, self.total, self.done, self.note, self.quiet = label, total, 0, "", quiet
        self._progress = progress
        self._task = progress.add_task(label, total=total, note="") if progress else None
        self._started = self._spoke = time.monotonic()

    def advance(self, count: int = 1, note: str = "") -> None:
        """Count finished units."""
        self.update(self.done + count, note)

    def show(self, done: int, total: int, note: str = "") -> None:
        """Show how far a worker is with the one unit that this is of."""
        if self._progress is not None and self._task is not None:
            self._progress.update(self._task, completed=done, total=total, note=note)

    def update(self, done: int, note: str = "", left: float | None = None) -> None:
        """Set the number of finished units. left: seconds until the end, where more is known than the pace so far."""
        self.done, self.note = done, note
        if self._progress is not None and self._task is not None:
            told = note or ("" if left is None else time_left(left))
            self._progress.update(self._task, completed=done, total=self.total, note=told)
        elif not self.quiet and time.monotonic() - self._spoke > PLAIN_INTERVAL_S:
            self._spoke = time.monotonic()
            if left is None:
                left = (self._spoke - self._started) / max(done, 1) * (self.total - done)
            text = f"  {self.label}: {done}/{self.total}, about {left:.0f} s left {note}"
            console.print(text, markup=False)

    def end(self) -> None:
        """Take it off the display."""
        if self._progress is not None and self._task is not None:
            self._progress.remove_task(self._task)


def time_left(seconds: float) -> str:
    """In words."""
    return f"about {seconds / 60:.0f} min left" if seconds > 90 else f"about {seconds:.0f} s left"


class _Display:
    """The one live display of this process: the meters of all threads, one below the other."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.meters: list[Meter] = []
        self.progress: Progress | None = None

    def begin(self, label: str, total: int, quiet: bool) -> Meter:
        with self.lock:
            if self.progress is None and console.is_terminal:
                self.progress = Progress(
                    TextColumn("  {task.description}", markup=False), BarColumn(), MofNCompleteColumn(),
                    TimeElapsedColumn(), TimeRemainingColumn(), TextColumn("{task.fields[note]}", markup=False),
                    console=console, transient=True,
                )  # fmt: skip
                self.progress.start()
            meter = Meter(label, total, self.progress, quiet)
            self.meters.append(meter)
            return meter

    def end(self, meter: Meter) -> None:
        with self.lock:
            self.meters.remove(meter)
            meter.end()
            if not self.meters and self.progress is not None:
                self.progress.stop()
                self.progress = None


_display = _Display()


def latest_meter() -> Meter | None:
    """The meter of what this process is at."""
    meters = _display.meters
    return meters[-1] if meters else None


@contextlib.contextmanager
def meter(label: str, total: int, quiet: bool = False) -> Iterator[Meter]:
    """A progress meter for `total` units of work, e.g. `with meter("render fox v3", 12) as m: m.advance()`.

    quiet: without lines of its own where there is no terminal, as one for all the work around it says more.
    """
    made = _display.begin(label, total, quiet)
    try:
        yield made
    finally:
        _display.end(made)
