"""Masks of transforms.json: kept in the store, out of the loss; masks that only say what an object is stay in it."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch

from cat3d_core.cameras import Cameras
from cat3d_core.reconstruction import Views
from flows.generation import brief
from flows.jobs.request import make_request
from flows.media.images import write_png
from flows.pipeline.runner import opened, run_missing
from flows.readers import read_capture
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


def test_masks_of_instant_ngp_are_said_to_be_left_out(tmp_path):
    cameras = small_cameras(64, 48)
    scene = LAYOUTS["transforms"](tmp_path / "scene", cameras, drawn(cameras), NAMES)
    photo = next(path for path in scene.rglob(NAMES[1]))
    write_png(photo.with_name(f"dynamic_mask_{photo.stem}.png"), np.zeros((48, 64), np.uint8))
    capture = read_capture(scene)
    assert len(capture) == COUNT
    (note,) = (note for note in capture.notes if "dynamic_mask_" in note)
    assert "of 1 photos) are not read" in note


def test_brief_fields_heed_masks_too(tmp_path, monkeypatch):
    """What decides on rounds and on pixels that photos show is trained on the same pixels as the field itself."""
    size = torch.tensor([[6, 4], [6, 4]])
    cameras = Cameras(torch.eye(3).expand(2, 3, 3), torch.eye(4).expand(2, 4, 4), size)
    mask = torch.arange(24).reshape(4, 6) % 3 > 0
    photos = [torch.zeros(4, 6, 3, dtype=torch.uint8) for _ in range(2)]
    views = Views.from_images(cameras, photos, torch.tensor([True, False]), [mask, None])
    seen = []

    def stop(job, views):
        seen.append(views)
        raise InterruptedError

    monkeypatch.setattr(brief, "brief_reconstruction", stop)
    with pytest.raises(InterruptedError):
        brief.shown_by_captured(None, views)
    assert torch.equal(seen[0].map(seen[0].valid, 0), mask)
    whole = Views.from_images(cameras, photos, torch.tensor([True, False]), weights=[None, mask.float()])
    with pytest.raises(InterruptedError):
        brief.shown_by_captured(None, whole)
    assert seen[1].valid is None  # as before there were masks: the same rays are drawn
