"""Progress of long work: rich bars on a terminal, a plain line now and then elsewhere (logs, CI, pipes)."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

console = Console(highlight=False)

PLAIN_INTERVAL_S = 15.0


class Meter:
    """Counts finished units of one piece of work. `note` is a short remark beside the bar (a loss, a view name)."""

    def __init__(self, label: str, total: int, progress: Progress | None) -> None:
        self.label, self.total, self.done = label, total, 0
        self._progress = progress
        self._task = progress.add_task(label, total=total, note="") if progress else None
        self._started = self._spoke = time.monotonic()

    def advance(self, count: int = 1, note: str = "") -> None:
        """Count finished units."""
        self.update(self.done + count, note)

    def update(self, done: int, note: str = "") -> None:
        """Set the number of finished units."""
        self.done = done
        if self._progress is not None and self._task is not None:
            self._progress.update(self._task, completed=done, note=note)
        elif time.monotonic() - self._spoke > PLAIN_INTERVAL_S:
            self._spoke = time.monotonic()
            elapsed = self._spoke - self._started
            left = elapsed / max(done, 1) * (self.total - done)
            text = f"  {self.label}: {done}/{self.total}, about {left:.0f} s left {note}"
            console.print(text, markup=False)


@contextlib.contextmanager
def meter(label: str, total: int) -> Iterator[Meter]:
    """A progress meter for `total` units of work, e.g. `with meter("render fox v3", 12) as m: m.advance()`."""
    if not console.is_terminal:
        yield Meter(label, total, None)
        return
    columns = (
        TextColumn("  {task.description}", markup=False), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(),
        TimeRemainingColumn(), TextColumn("{task.fields[note]}", markup=False),
    )  # fmt: skip
    with Progress(*columns, console=console, transient=True) as progress:
        yield Meter(label, total, progress)
