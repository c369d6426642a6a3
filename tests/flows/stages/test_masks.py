"""Masks of transforms.json: kept in the store, out of the loss; masks that only say what an object is stay in it."""

from __future__ import annotations

import json

import numpy as np
import pytest

from flows.jobs.request import make_request
from flows.media.images import write_png
from flows.pipeline.runner import opened, run_missing
from flows.stages.training_views import training_views
from schemas.scene_store import SceneStore
from tests.flows.readers.layouts import LAYOUTS
from tests.flows.readers.test_pixels import COUNT, drawn, small_cameras

NAMES = [f"{i:03d}.png" for i in range(COUNT)]


@pytest.mark.parametrize("layout", ["transforms", "dtu"])
def test_which_pixels_are_trained_on(tmp_path, layout):
    cameras = small_cameras(64, 48)
    LAYOUTS[layout](tmp_path / "scene", cameras, drawn(cameras), NAMES)
    masks = tmp_path / "scene" / ("mask" if layout == "dtu" else "masks")
    masks.mkdir()
    for name in NAMES:
        mask = np.zeros((48, 64), np.uint8)
        mask[:12] = 255
        write_png(masks / name, mask)
    if layout == "transforms":
        content = json.loads((tmp_path / "scene" / "transforms.json").read_text())
        for frame, name in zip(content["frames"], NAMES, strict=True):
            frame["mask_path"] = f"masks/{name}"
        (tmp_path / "scene" / "transforms.json").write_text(json.dumps(content))
    (job,) = make_request(tmp_path / "scene", tmp_path / "out", "all", {"method": "zipnerf"}).jobs()
    with opened(job):
        run_missing(job, until="poses")
    store = SceneStore.open(job.store_path)
    assert (store.captured.read("mask")[:, 0] == 255).all()
    views, decisions = training_views(job, store, store.run(job.run))
    whole = layout == "dtu"
    assert views.counting.tolist() == [64 * (48 if whole else 12)] * len(job.split["train"])
    assert any("masks" in d.text for d in decisions) != whole
