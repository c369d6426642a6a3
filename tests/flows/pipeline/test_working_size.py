"""Large photos: the size they are worked on, what is said of it and of the time, and that few are in memory at once."""

from __future__ import annotations

import weakref
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from flows.bench.size import phone_photos
from flows.jobs.request import make_request
from flows.media import images
from flows.pipeline import working_size
from flows.pipeline.expected import duration, expected
from flows.pipeline.keys import pending
from flows.pipeline.runner import opened, run_missing
from flows.pipeline.working_size import LEAST_PIXELS, with_working_size
from flows.stages import ingest
from flows.stages.training_views import training_views
from schemas.scene_store import SceneStore

SCENE = "procedural:llff/2?views=9&width={}&height={}"


def sized(source: str, tmp_path: Path, preset: str = "tiny", **given):
    request = make_request(source, tmp_path / "out", "3,all", {"preset": preset, "method": "zipnerf"} | given)
    return with_working_size(request.jobs())


def test_small_photos_keep_their_size_and_their_keys(tmp_path: Path) -> None:
    source = SCENE.format(418, 313)
    open_, given = sized(source, tmp_path), sized(source, tmp_path, downscale=1)
    assert [job.config.ingest.downscale for job in open_] == [1.0, 1.0]
    assert not open_[0].working_size
    assert pending(open_[0])[0].key == pending(given[0])[0].key


@pytest.mark.parametrize(("preset", "size"), [("tiny", (418, 313)), ("fast", (418, 313)), ("balanced", (1280, 960))])
def test_large_photos_get_the_size_that_the_preset_can_fill(tmp_path: Path, monkeypatch, preset, size) -> None:
    monkeypatch.setattr(working_size, "total_memory", lambda: 16 * 2**30)
    for job in sized(SCENE.format(2048, 1536), tmp_path, preset):
        scale = job.config.ingest.downscale
        assert (round(2048 / scale), round(1536 / scale)) == size
        assert f"worked on at {size[0]} x {size[1]}" in job.working_size
        assert f"--downscale takes another size: {scale:g} is this one" in job.working_size


def test_what_the_user_asks_for_is_done(tmp_path: Path) -> None:
    (job, _) = sized(SCENE.format(2048, 1536), tmp_path, downscale=2)
    assert job.config.ingest.downscale == 2
    assert not job.working_size


def test_photos_take_a_share_of_the_memory(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(working_size, "total_memory", lambda: 3 * 2**20)  # counts as two
    (job, _) = sized(SCENE.format(2048, 1536), tmp_path, "balanced")
    pixels = 2048 * 1536 / job.config.ingest.downscale**2
    assert pixels * 9 * working_size.PIXEL_BYTES <= 2**21 * working_size.MEMORY_SHARE
    assert "9 of them may take of the memory" in job.working_size
    monkeypatch.setattr(working_size, "total_memory", lambda: None)
    assert 2048 * 1536 / sized(SCENE.format(2048, 1536), tmp_path)[0].config.ingest.downscale ** 2 <= LEAST_PIXELS


def test_time_and_memory_are_said_before(tmp_path: Path) -> None:
    job, other = sized(SCENE.format(2048, 1536), tmp_path)
    sentence = expected([(job, pending(job)), (other, pending(other))])
    assert sentence.startswith("Expected, by what two CPU cores usually take: about ")
    assert sentence.endswith(" GB of memory.")
    assert [duration(s) for s in (3, 61, 100, 7200)] == [
        "about 10 seconds", "about 60 seconds", "about 2 minutes", "about 2.0 hours",
    ]  # fmt: skip


def test_photos_go_to_the_store_a_few_at_a_time(tmp_path: Path, monkeypatch) -> None:
    """Of 12 photos never more are in memory than two that are read and the chunk that is written, at the small size."""
    phone_photos(tmp_path / "photos", 12, 320, 240)
    alive, most = Counter(), Counter()

    def watched(values: np.ndarray, name: str) -> np.ndarray:
        alive[name] += 1
        most[name] = max(most[name], alive[name])
        weakref.finalize(values, alive.subtract, [name])
        return values

    read, resize = images.read_image, images.resize
    monkeypatch.setattr(images, "read_image", lambda *a, **k: (watched(read(*a, **k)[0], "whole"), None))
    monkeypatch.setattr(images, "resize", lambda *a: watched(resize(*a), "small"))
    given = {"downscale": 4, "method": "zipnerf"}
    request = make_request(tmp_path / "photos", tmp_path / "out", "all", given, settings=["ingest.check_cameras=false"])
    (job,) = request.jobs()
    with opened(job):
        run_missing(job, until="poses")
    assert 0 < most["whole"] <= 2 + 1
    assert 0 < most["small"] <= ingest.CHUNK + 2
    store = SceneStore.open(job.store_path)
    assert store.captured.shape("image") == (12, 60, 80, 3)
    views, _ = training_views(job, store, store.run(job.run))
    first = job.split["train"][0]
    assert np.array_equal(views.image(0).numpy(), store.captured.read_image("image", first))
