"""The photos' own depths: each pixel has that of its place in the sample, and on a scene with known depths they are
near those."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from cat3d_core.matching.hint import observe, photo_depth
from flows.generation.hints import open_sweep
from flows.generation.photo_depths import SIDE, photo_depths, photos
from flows.jobs.access import read_cameras, read_similarity
from flows.jobs.request import Request, make_config
from schemas.scene_store import SceneStore
from tests.flows.workers.scene import run_stages

SETTINGS = ("method=cat3d", "plan.views=8", "skip.covered_path=false")


@pytest.mark.parametrize(("size", "kind"), [((48, 48), "square"), ((48, 36), "wide"), ((30, 44), "wide")])
def test_a_pixel_has_the_depth_of_its_place_in_the_sample(tmp_path: Path, size: tuple[int, int], kind: str) -> None:
    width, height = size
    source = f"procedural:dtu/3?views=9&width={width}&height={height}"
    job = Request(source, tmp_path, ("3",), make_config({}, None, list(SETTINGS))).jobs()[0]
    run_stages(job, "ingest", "poses")
    store, views = SceneStore.open(job.store_path), [0, 4, 8]
    network = open_sweep(job)
    image, cameras = photos(store, views, kind, SIDE)
    inverse, _ = photo_depth(network, observe(network, image, cameras))
    own = read_cameras(store.captured, views)
    for index, (depth, trust) in enumerate(photo_depths(job, store, views)):
        assert depth.shape == trust.shape == (height, width)
        assert 0 <= float(trust.min()) <= float(trust.max()) <= 1
        for x, y in ((0, 0), (width - 1, height - 1), (width // 3, height // 2)):
            # By the cameras: the pixel's ray, and where the sample's camera sees it.
            ray = torch.linalg.inv(own.intrinsics[index]) @ torch.tensor([x + 0.5, y + 0.5, 1.0]).to(own.intrinsics)
            column, row, _ = (cameras.intrinsics[index] @ ray / 2).long().tolist()
            assert 1 / float(depth[y, x]) == pytest.approx(float(inverse[index, row, column]), rel=1e-5)


def test_depths_of_a_scene_are_near_the_true_ones(tmp_path: Path) -> None:
    source = "procedural:llff/2?views=9&width=64&height=48"
    job = Request(source, tmp_path, ("3",), make_config({}, None, list(SETTINGS))).jobs()[0]
    run_stages(job, "ingest", "poses")
    store, views = SceneStore.open(job.store_path), [0, 4, 8]
    truth = job.capture().depths
    assert truth is not None
    for view, (depth, trust) in zip(views, photo_depths(job, store, views), strict=True):
        known = torch.from_numpy(truth[view]).float() * read_similarity(store).scale
        off = (1 / depth - 1 / known).abs()
        assert float(off.median()) < 0.06
        assert float((trust > 0).float().mean()) > 0.3
        assert float(off[trust > 0].mean()) < float(off[trust == 0].mean()), "what no other photo confirms is worse"
