"""Two scenes of one name into one --out: the second is refused, and nothing of the first is touched."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from flows.jobs.job import Job
from flows.jobs.request import Request, make_config
from flows.media.images import write_png
from flows.pipeline.runner import opened, run_missing
from schemas.errors import StoreError
from schemas.scene_store import SceneStore


def photos(folder: Path, seed: int) -> Path:
    folder.mkdir(parents=True)
    random = np.random.default_rng(seed)
    for i in range(4):
        write_png(folder / f"{i}.png", random.integers(0, 255, (24, 32, 3)).astype(np.uint8))
    return folder


def job(source: Path, out: Path) -> Job:
    return Request(str(source), out, ("all",), make_config({}, None, [])).jobs()[0]


def ingest(source: Path, out: Path) -> Job:
    one = job(source, out)
    with opened(one):
        run_missing(one, until="ingest")
    return one


def test_another_scene_of_the_same_name_is_refused(tmp_path: Path) -> None:
    first = ingest(photos(tmp_path / "a" / "kitchen", 1), tmp_path / "out")
    before = SceneStore.open(first.store_path).captured.read("image")
    with pytest.raises(StoreError, match=r"holds the scene of .*a/kitchen, and .*b/kitchen is another one of the same"):
        ingest(photos(tmp_path / "b" / "kitchen", 2), tmp_path / "out")
    assert np.array_equal(SceneStore.open(first.store_path).captured.read("image"), before)


def test_a_scene_that_was_moved_or_added_to_is_the_same(tmp_path: Path) -> None:
    source = photos(tmp_path / "a" / "kitchen", 1)
    ingest(source, tmp_path / "out")
    moved = tmp_path / "b" / "kitchen"
    moved.parent.mkdir()
    shutil.move(source, moved)
    write_png(moved / "4.png", np.zeros((24, 32, 3), np.uint8))
    one = ingest(moved, tmp_path / "out")
    assert SceneStore.open(one.store_path).captured.shape("image")[0] == 5
