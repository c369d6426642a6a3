"""Comparisons with other programs: tasks reach other processes whole, ours answers, and what is missing is said."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import numpy as np
import pytest

from flows.bench.peers import compare
from flows.bench.peers.task import Curve, Task, read_task, write_task
from flows.bench.rows import MissingError
from flows.errors import InputError


def test_a_task_comes_back_as_it_was_written(tmp_path: Path) -> None:
    task = Task({"seconds": 1.5, "threads": 1}, {"images": np.arange(12, dtype=np.uint8).reshape(3, 4)})
    write_task(tmp_path, task)
    found = read_task(tmp_path)
    assert found.settings == task.settings
    assert np.array_equal(found.arrays["images"], task.arrays["images"])


def test_the_clock_of_a_curve_stands_still_while_a_point_is_measured() -> None:
    curve = Curve(np.full((2, 3, 4, 3), 255, np.uint8))
    curve.train(lambda: None)
    before = curve.seconds
    curve.point(1, lambda _: np.full((3, 4, 3), 0.9))
    assert curve.seconds == before
    assert curve.rows[0]["psnr_db"] == pytest.approx(20)


def test_without_the_peers_the_command_that_installs_them_is_named(monkeypatch, tmp_path: Path) -> None:
    monkeypatch.setenv(compare.VARIABLE, str(tmp_path))
    with pytest.raises(MissingError, match="make peers"):
        compare.rows(True, None)


def test_our_side_of_a_reconstruction_is_a_curve() -> None:
    task = compare.reconstruction_task("dtu", 3, 16, seed=0, threads=1, preset="tiny")
    settings = task.settings | {"change": {"iterations": 33, "warmup_iterations": 3, "batch_rays": 64}}
    rows = compare.measure(sys.executable, "zipnerf", Task(settings, task.arrays))
    assert [row["step"] for row in rows] == [32, 33]
    assert rows[0]["seconds"] < rows[1]["seconds"]
    assert all(row["psnr_db"] > 8 and row["peak_mb"] > 50 for row in rows)


def test_a_process_that_fails_is_quoted() -> None:
    with pytest.raises(InputError, match="KeyError: 'train_images'"):
        compare.measure(sys.executable, "zipnerf", Task({"threads": 1, "preset": "tiny", "seed": 0}, {}))


def test_readers_of_a_store_agree() -> None:
    pytest.importorskip("xarray")
    rows = compare.reading_rows(3, 16, 1, 1)
    assert [row["who"] for row in rows] == ["cat3d", "zarr", "xarray"]
    assert all(row["error"] == 0 for row in rows)


@pytest.mark.slow
@pytest.mark.skipif(not (Path(os.environ.get(compare.VARIABLE, compare.CHECKOUT / ".venv-peers"))).exists(),
                    reason="The peers are not installed (`make peers`).")  # fmt: skip
def test_the_peers_answer() -> None:
    rows = compare.sampler_rows(2, (8,), 1) + compare.network_rows(1, 1, 1) + compare.metric_rows(1, 32, 32, 1, 1)
    assert {"cat3d", "diffusers", "torchmetrics"} <= {row["who"] for row in rows}
