"""The ladder: coarse pictures first, for all that wait; a camera that moves on stops what was rendered for it."""

from __future__ import annotations

import queue
import threading
from collections.abc import Iterator

import numpy as np
import pytest
import torch

from cat3d_core.cameras import Cameras
from cat3d_core.reconstruction import Render
from cat3d_core.splats.rasterize import render
from flows.viewer.ladder import Ladder, Picture, StoppedError, Wish, tiles
from tests.core.splats.scenes import camera, gaussians


class Scene:
    """Splats that count the tiles they render, and wait before each one where a gate is given."""

    def __init__(self, seed: int = 0, gate: threading.Semaphore | None = None) -> None:
        self.splats, self.gate, self.sizes = gaussians(60, seed).to(dtype=torch.float32), gate, []

    def render(self, cameras: Cameras, index: int, scale: float = 1.0) -> Render:
        if self.gate is not None:
            assert self.gate.acquire(timeout=30)
        self.sizes.append(cameras.size[index].tolist())
        return render(self.splats, cameras, index, scale)

    def uncertainty(self, cameras: Cameras, index: int) -> None:
        return None


Shown = queue.Queue[tuple[int, Wish, Picture]]


@pytest.fixture
def shown() -> Shown:
    return queue.Queue()


@pytest.fixture
def ladder(shown: Shown) -> Iterator[Ladder]:
    made = Ladder(lambda who, wish, picture: shown.put((who, wish, picture)))
    yield made
    made.stop()


def wish(scene: Scene, channel: str = "colour", **more: object) -> Wish:
    return Wish(camera(250, 130).to(dtype=torch.float32), channel, scene, **more)  # type: ignore[arg-type]


def test_tiles_cover_the_image_once_the_middle_first() -> None:
    seen = np.zeros((130, 250), int)
    areas = list(tiles(250, 130, 64))
    for rows, columns in areas:
        seen[rows, columns] += 1
    assert (seen == 1).all()
    rows, columns = areas[0]
    assert rows.start <= 65 < rows.stop
    assert columns.start <= 125 < columns.stop


def test_pictures_come_in_rising_sizes_and_the_last_is_the_render(ladder: Ladder, shown: Shown) -> None:
    scene = Scene()
    asked = wish(scene)
    ladder.look(7, asked)
    found = [shown.get(timeout=60) for _ in range(4)]
    assert [who for who, _, _ in found] == [7] * 4
    assert [picture.scale for *_, picture in found] == [1 / 8, 1 / 4, 1 / 2, 1]
    assert [picture.image.shape for *_, picture in found] == [(16, 31, 3), (32, 62, 3), (65, 125, 3), (130, 250, 3)]
    whole = render(scene.splats, asked.camera, 0)
    last = found[-1][2]
    assert np.abs(last.image.astype(int) - (whole.image.numpy() * 255)).max() < 1.01
    np.testing.assert_allclose(last.depth, whole.depth.numpy(), rtol=1e-4)


def test_a_camera_that_moves_on_stops_its_old_picture(ladder: Ladder, shown: Shown) -> None:
    gate = threading.Semaphore(0)
    slow, quick = Scene(gate=gate), Scene()
    ladder.look(1, wish(slow))
    ladder.look(1, wish(quick))
    for _ in range(2):
        gate.release()  # what is being rendered, if anything, comes to its end
    found = [shown.get(timeout=60) for _ in range(4)]
    assert all(done.scene is quick for _, done, _ in found)
    assert len(slow.sizes) <= 1


def test_two_browsers_both_see_something_before_either_sees_the_finest(ladder: Ladder, shown: Shown) -> None:
    gate = threading.Semaphore(0)
    scenes = Scene(0, gate), Scene(1, gate)
    for who, scene in enumerate(scenes):
        ladder.look(who, wish(scene))
    for _ in range(100):
        gate.release()
    found = [shown.get(timeout=60) for _ in range(8)]
    assert {who for who, *_ in found[:2]} == {0, 1}
    assert {picture.scale for *_, picture in found[-2:]} == {1.0}


@pytest.mark.parametrize("channel", ["depth", "normals", "opacity", "uncertainty"])
def test_channels_are_pictures(ladder: Ladder, shown: Shown, channel: str) -> None:
    ladder.look(0, wish(Scene(), channel))
    *_, picture = shown.get(timeout=60)
    assert picture.image.dtype == np.uint8
    assert picture.image.shape == (16, 31, 3)
    assert bool(picture.image.any()) == (channel != "uncertainty")  # splats know nothing of theirs


def test_two_scenes_side_by_side(ladder: Ladder, shown: Shown) -> None:
    a, b = Scene(0), Scene(1)
    asked = wish(a, other=b, split=0.3)
    ladder.look(0, asked)
    *_, picture = [shown.get(timeout=60) for _ in range(4)][-1]
    edge = round(0.3 * 250)
    for scene, columns in ((a, slice(0, edge)), (b, slice(edge, 250))):
        whole = render(scene.splats, asked.camera, 0).image.numpy() * 255
        assert np.abs(picture.image[:, columns] - whole[:, columns]).max() < 1.01


def test_a_scene_that_fails_does_not_stop_the_others(
    ladder: Ladder, shown: Shown, capfd: pytest.CaptureFixture[str]
) -> None:
    class Broken(Scene):
        def render(self, cameras: Cameras, index: int, scale: float = 1.0) -> Render:
            raise RuntimeError("no view today")

    ladder.look(0, wish(Broken()))
    ladder.look(1, wish(Scene()))
    assert [shown.get(timeout=60)[0] for _ in range(4)] == [1] * 4
    assert "no view today" in capfd.readouterr().err


def test_other_work_waits_for_the_coarse_pictures_and_ends_with_the_ladder(shown: Shown) -> None:
    ladder, gate = Ladder(lambda who, asked, picture: shown.put((who, asked, picture))), threading.Semaphore(0)
    done: queue.Queue[str] = queue.Queue()

    def work() -> None:
        try:
            ladder.wait()
            done.put("waited")
            ladder.wait()
        except StoppedError:
            done.put("stopped")

    ladder.look(0, wish(Scene(gate=gate)))
    worker = threading.Thread(target=work, daemon=True)
    worker.start()
    for _ in range(4):  # one tile each of an eighth and a quarter, two of a half; none yet of the whole picture
        gate.release()
    assert [shown.get(timeout=60)[2].scale for _ in range(3)] == [1 / 8, 1 / 4, 1 / 2]
    assert done.get(timeout=60) == "waited"
    ladder.look(0, wish(Scene(gate=gate)))
    for _ in range(100):
        gate.release()
    ladder.stop()
    worker.join(timeout=60)
    assert not worker.is_alive()
