"""Odd names of folders, photos and masks, through every layout, into the store."""

from __future__ import annotations

import json
import os
import unicodedata

import numpy as np
import pytest

from flows.jobs.job import Job
from flows.media.images import write_png
from flows.readers import read_capture
from flows.stages import ingest
from schemas.config import RunConfig
from schemas.scene_store import SceneStore
from tests.flows.readers.layouts import LAYOUTS, NAMED, colmap_text, transforms
from tests.flows.readers.test_pixels import COUNT, assert_point_is_where_cameras_see_it, drawn, small_cameras

LATIN_1 = os.fsdecode(b"K\xfcche")
# What a file system allows and people write.
ODD = {
    "spaces": "my photo",
    "umlauts": "Küche ß",
    "umlauts as macOS writes them": unicodedata.normalize("NFD", "Küche"),
    "brackets": "photo [1] (2) {3}",
    "markup": "[bold] [red]x",
    "colon": "12:30:05",
    "dots": "a..b.c..",
    "backslash": "a\\b",
    "question and hash": "what?#%04d",
    "quotes": 'it\'s "so" `$HOME`',
    "Japanese": "写真",
    "Latin-1 bytes": LATIN_1,
}


def png(path, pixels) -> None:
    """Write through a plain name: the target's own may be one that image libraries read as something else."""
    plain = path.with_name("plain.png")
    write_png(plain, pixels)
    plain.rename(path)


@pytest.mark.parametrize("odd", [n for n in ODD.values() if n != LATIN_1], ids=[k for k in ODD if "Latin" not in k])
@pytest.mark.parametrize("name", NAMED)
def test_photos_of_any_name(tmp_path, name, odd):
    cameras = small_cameras(64, 48)
    names = [f"{odd}{i}.png" for i in range(COUNT)]
    capture = read_capture(LAYOUTS[name](tmp_path / "scene", cameras, drawn(cameras), names, png))
    assert len(capture) == COUNT
    assert_point_is_where_cameras_see_it(capture)


@pytest.mark.parametrize("encoding", ["latin-1", "utf-8"])
@pytest.mark.parametrize("on_disk", ["latin-1", "utf-8"])
def test_lists_and_file_systems_of_different_encodings(tmp_path, encoding, on_disk):
    cameras = small_cameras(64, 48)
    names = [f"Küche{i}.png" for i in range(COUNT)]
    colmap_text(tmp_path, cameras, drawn(cameras), names, png)
    for file in (tmp_path / "images").iterdir():
        file.rename(file.with_name(os.fsdecode(file.name.encode(on_disk))))
    listed = tmp_path / "sparse" / "0" / "images.txt"
    listed.write_bytes(listed.read_text().encode(encoding))
    capture = read_capture(tmp_path)
    assert capture.names == names
    assert_point_is_where_cameras_see_it(capture)


@pytest.mark.parametrize("name", LAYOUTS)
@pytest.mark.parametrize("odd", ODD.values(), ids=ODD.keys())
def test_folders_of_any_name_go_into_the_store(tmp_path, name, odd):
    cameras = small_cameras(64, 48)
    folder = tmp_path / odd
    path = LAYOUTS[name](folder, cameras, drawn(cameras), [f"{i:03d}.png" for i in range(COUNT)], png)
    capture = read_capture(path)
    capture.title.encode("utf-8")
    job = Job(source=str(tmp_path), out=tmp_path / "out", scene_id=capture.scene_id, dataset="x", config=RunConfig())
    assert job.store_path.name.isascii()
    if name in ("transforms", "dtu"):  # the others differ in reading alone
        store = SceneStore.create(job.store_path, capture.scene_id, capture.dataset, {"source": "x"})
        views = [ingest.ingest_view(capture, v, job.config.ingest) for v in range(COUNT)]
        job.scene.__dict__["capture"] = capture
        ingest.write_captured(store, capture, job, views)
        assert [str(n) for n in store.captured.read("name")] == capture.names
        assert store.captured.attrs["title"] == capture.title


def test_masks_of_odd_names(tmp_path):
    cameras = small_cameras(64, 48)
    names = [f"{i:03d}.png" for i in range(COUNT)]
    transforms(tmp_path, cameras, drawn(cameras), names)
    content = json.loads((tmp_path / "transforms.json").read_text())
    for i, frame in enumerate(content["frames"]):
        frame["mask_path"] = f"Masken [{i}]\\wei\u00df?#.png"
        (tmp_path / f"Masken [{i}]").mkdir()
        png(tmp_path / f"Masken [{i}]" / "weiß?#.png", np.full((48, 64, 3), 255, np.uint8))
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    capture = read_capture(tmp_path)
    assert None not in capture.masks
    assert capture.mask_training
    assert ingest.ingest_view(capture, 0, RunConfig().ingest).mask.min() == 255
