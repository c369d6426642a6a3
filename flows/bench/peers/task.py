"""What a process is asked to measure, and what it answers: a folder with request.json, arrays.npz and rows.json.

Read by processes of ours and of the peers' environment alike: needs numpy alone.
"""

from __future__ import annotations

import json
import resource
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

#: Read before anything heavy is imported, so that `start_up` counts that too.
STARTED = time.perf_counter()
Row = dict[str, Any]


@dataclass(frozen=True)
class Task:
    """Settings, and arrays by name. For reconstruction: `train_images` (N, H, W, 3) uint8, `train_intrinsics`
    (N, 3, 3) in pixels, `train_cameras` (N, 4, 4) world_from_camera with OpenCV axes, the same with `test_`."""

    settings: Row
    arrays: dict[str, np.ndarray]


def write_task(folder: Path, task: Task) -> None:
    """Lay a task into a folder."""
    (folder / "request.json").write_text(json.dumps(task.settings), encoding="utf-8")
    np.savez(folder / "arrays.npz", **task.arrays)  # type: ignore[arg-type]


def read_task(folder: Path) -> Task:
    """The task in a folder."""
    with np.load(folder / "arrays.npz", allow_pickle=False) as arrays:
        return Task(json.loads((folder / "request.json").read_text(encoding="utf-8")), dict(arrays))


def answer(measure: Callable[[Task], Sequence[Row]]) -> None:
    """The whole of a process: measure the task in the folder that the command line names, and write the rows."""
    folder = Path(sys.argv[1])
    rows = [row | {"peak_mb": peak_megabytes()} for row in measure(read_task(folder))]
    (folder / "rows.json").write_text(json.dumps(rows), encoding="utf-8")


def peak_megabytes() -> float:
    """The most memory this process has held."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


@dataclass
class Curve:
    """PSNR of held-out views against seconds of training: `seconds` stand still while a point is measured."""

    test_images: np.ndarray
    start_up: float = field(default_factory=lambda: time.perf_counter() - STARTED)
    seconds: float = 0.0
    cpu_seconds: float = 0.0
    rows: list[Row] = field(default_factory=list)

    def train(self, step: Callable[[], Any]) -> None:
        """One step, on the clock."""
        wall, cpu = time.perf_counter(), time.process_time()
        step()
        self.seconds += time.perf_counter() - wall
        self.cpu_seconds += time.process_time() - cpu

    def point(self, step: int, render: Callable[[int], np.ndarray], **more: Any) -> None:
        """Render every test view, (H, W, 3) in [0, 1], off the clock, and keep a row."""
        wall, errors = time.perf_counter(), []
        for index, image in enumerate(self.test_images):
            difference = np.clip(render(index), 0, 1).astype(np.float64) - image / 255.0
            errors.append(-10 * np.log10(np.mean(difference**2)))
        rays = self.test_images.shape[0] * self.test_images.shape[1] * self.test_images.shape[2]
        self.rows.append(
            {"step": step, "seconds": self.seconds, "cpu_seconds": self.cpu_seconds, "psnr_db": float(np.mean(errors)),
             "render_rays_per_s": rays / (time.perf_counter() - wall), "start_up_seconds": self.start_up, **more}
        )  # fmt: skip
