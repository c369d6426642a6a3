"""`cat3d view` in a real browser: splats while moving, the reconstruction itself when resting, two browsers at once."""

from __future__ import annotations

import json
import math
import shutil
import signal
import socket
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from flows.errors import InputError
from flows.exports.path import read_path
from flows.jobs.request import Request, make_config
from flows.media.images import resize
from flows.pipeline.runner import opened, run_missing
from flows.viewer.keyframes import as_bytes, nerfstudio_document, path_document
from flows.viewer.server import HOST, Viewer, run_names
from flows.viewer.session import Session
from tests.e2e.browser import Browser, chromium, free_port, until
from tests.flows.conftest import ROOT, environment

SCENE = "procedural:co3d/1?views=12&width=48&height=36"
RUN = "vall-splats"


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of splats, made without a server."""
    out = tmp_path_factory.mktemp("view")
    settings = ["reconstruct.method=splats", "reconstruct.preset=tiny", "render.path_views=2"]
    config = make_config({"method": "zipnerf", "preset": "fast"}, None, settings)
    [job] = Request(SCENE, out, ("all",), config).jobs()
    with opened(job):
        run_missing(job, until="evaluate")
    assert job.run == RUN
    return job.store_path


@pytest.fixture
def viewer(store: Path) -> Iterator[Viewer]:
    made = Viewer(store, None, free_port())
    yield made
    made.stop()


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with chromium(tmp_path_factory.mktemp("profile"), 640, 480) as found:
        yield found


def rested(viewer: Viewer, count: int = 1) -> list[Session]:
    """The sessions of so many browsers, once all rest on a picture of full size."""
    until(lambda: len(viewer.sessions) == count)
    sessions = list(viewer.sessions.values())
    until(lambda: all(is_sharp(session) for session in sessions))
    return sessions


def is_sharp(session: Session) -> bool:
    return session.shown_picture is not None and session.shown_picture[1].scale == 1


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(-10 * math.log10(np.square(a.astype(float) / 255 - b.astype(float) / 255).mean() + 1e-12))


@pytest.mark.slow
def test_the_page_needs_no_network_and_shows_what_the_reconstruction_renders(
    viewer: Viewer, browser: Browser, tmp_path: Path
) -> None:
    tab = browser.open(f"http://{HOST}:{viewer.port}")
    [session] = rested(viewer)
    assert session.run is not None
    assert session.run.scene is not None
    wish, picture = session.shown_picture or pytest.fail("It moves again.")
    whole = session.run.scene.render(wish.camera.to(dtype=torch.float32), 0)
    assert np.abs(picture.image - whole.image.numpy() * 255).max() < 1.01
    names = tab.run("performance.getEntriesByType('resource').map(entry => entry.name)")
    assert [name for name in names if f"{HOST}:{viewer.port}" not in name and not name.startswith("data:")] == []
    # What the browser shows is that picture, to the left of the panel and below its notices.
    shown = until(lambda: _like(tab.screenshot(tmp_path / "shot.png"), session), every=2)
    assert shown > 30
    tab.close()


def _like(screen: np.ndarray, session: Session) -> float | None:
    """PSNR of the lower left part of a screen to the picture that it should show, once it is like it."""
    if session.shown_picture is None:
        return None
    height, width = screen.shape[:2]
    wanted = resize(session.shown_picture[1].image, width, height)
    part = slice(height // 2, height - 90), slice(100, width // 2 - 60)
    found = psnr(screen[part], wanted[part])
    print(f"screen {found:.1f} dB")
    return found if found > 30 else None


@pytest.mark.slow
def test_splats_are_drawn_like_ours(viewer: Viewer, browser: Browser) -> None:
    """The browser's own picture of the splats at three cameras, against the reconstruction's."""
    tab = browser.open(f"http://{HOST}:{viewer.port}")
    [session] = rested(viewer)
    assert session.run is not None
    assert session.run.scene is not None
    for name in ("captured", "held out", "generated", "planned", "path", "points", "reconstruction"):
        session.panel.show(name, False)
    session.moved()
    from flows.viewer.cameras import camera_of, place, vertical_fov

    found = []
    for view in session.run.views[:9:4]:
        wxyz, position = place(view.camera)
        fov = vertical_fov(view.camera)
        drawn = session.client.get_render(
            240, 320, wxyz=wxyz, position=position, fov=fov, transport_format="png", timeout=120
        )
        ours = session.run.scene.render(camera_of(wxyz, position, fov, 320, 240).to(dtype=torch.float32), 0)
        found.append(psnr(drawn[..., :3], ours.image.numpy() * 255))
    print(f"splats in the browser against ours: {[round(value, 1) for value in found]} dB")
    assert min(found) > 22
    tab.close()


@pytest.mark.slow
def test_moving_shows_splats_and_two_browsers_do_not_disturb_each_other(viewer: Viewer, browser: Browser) -> None:
    tabs = [browser.open(f"http://{HOST}:{viewer.port}") for _ in range(2)]
    one, two = rested(viewer, 2)
    before = two.shown_picture
    place = one.client.camera.position.copy()
    # Which tab is whose does not matter: the one that is dragged moves, the other does not.
    tabs[0].drag((200, 300), (80, 20))
    until(lambda: not np.allclose(one.client.camera.position, place) or two.shown_picture is not before)
    moved, still = (one, two) if not np.allclose(one.client.camera.position, place) else (two, one)
    assert is_sharp(still)
    until(lambda: is_sharp(moved))
    for tab in tabs:
        tab.close()


def test_keyframes_become_paths_that_export_reads(store: Path, tmp_path: Path) -> None:
    """Ours and nerfstudio's say the same cameras, in the frame of the data set."""
    from flows.reporting.content import captured_views
    from flows.viewer.keyframes import smooth_path
    from flows.viewer.run import OpenRun
    from schemas.scene_store import SceneStore

    opened_store = SceneStore.open(store)
    run = OpenRun(RUN, opened_store, opened_store.run(RUN))
    run.read()
    assert run.frame_from_scene is not None
    views = list(captured_views(opened_store, run.run))
    path = smooth_path([view.camera for view in views[:3]], 20)
    wanted = run.frame_from_scene.cameras(path)
    for name, document in (("path.json", path_document), ("camera_path.json", nerfstudio_document)):
        (tmp_path / name).write_bytes(as_bytes(document(path, run.frame_from_scene)))
        read = read_path(tmp_path / name, 5, 5)
        assert read.fps == 30
        assert read.cameras.size.tolist() == path.size.tolist()
        torch.testing.assert_close(read.cameras.world_from_camera, wanted.world_from_camera)
        torch.testing.assert_close(read.cameras.intrinsics, path.intrinsics, rtol=1e-9, atol=1e-9)
    for at, view in ((0, views[0]), (19, views[2])):
        torch.testing.assert_close(path.world_from_camera[at], view.camera.world_from_camera[0])
    fisheye = json.loads((tmp_path / "camera_path.json").read_text()) | {"camera_type": "fisheye"}
    (tmp_path / "camera_path.json").write_text(json.dumps(fisheye))
    with pytest.raises(InputError, match="fisheye"):
        read_path(tmp_path / "camera_path.json", 5, 5)


def test_the_command_listens_on_loopback_only_and_ends_with_ctrl_c(store: Path) -> None:
    port = free_port()
    command = [sys.executable, "-m", "flows.cli", "view", str(store.parent), "--port", str(port)]
    process = subprocess.Popen(command, cwd=ROOT, env=environment(), stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        until(lambda: f"http://{HOST}:{port}" in (process.stdout.readline() if process.stdout else ""))
        page = urllib.request.urlopen(f"http://{HOST}:{port}", timeout=60).read()
        assert b"<html" in page
        addresses = {info[4][0] for info in socket.getaddrinfo(socket.gethostname(), port, socket.AF_INET)}
        for address in addresses - {HOST}:
            if not address.startswith("127."):
                with pytest.raises(OSError):
                    socket.create_connection((str(address), port), timeout=5)
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=60) == 0
    finally:
        process.kill()


def test_what_cannot_be_shown(store: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds no scene store"):
        run_names(tmp_path)
    with pytest.raises(InputError, match=f"has no run other to show; its runs are: {RUN}"):
        Viewer(store, "other", free_port())


def test_a_folder_lists_its_runs_and_their_numbers_sorted(store: Path) -> None:
    made = Viewer(store.parent, None, free_port())
    try:
        assert made.names == [f"procedural_co3d_1 / {RUN}"]
        assert made.table is not None
        psnr_column = next(name for name in made.table.columns if "PSNR" in name)
        assert RUN in made.table.html(psnr_column, rising=False)
        assert made.opened(made.first).scene is not None
    finally:
        made.stop()


def test_a_store_that_grows_is_followed(store: Path, tmp_path: Path) -> None:
    """Before the reconstruction is finished there are cameras only; afterwards it is there at the next look."""
    from schemas.scene_store import SceneStore

    copy = tmp_path / store.name
    shutil.copytree(store, copy)
    record = SceneStore.open(copy).record("reconstruct", RUN)
    assert record is not None
    SceneStore.open(copy, "r+").forget("reconstruct", RUN)
    made = Viewer(copy, None, free_port())
    try:
        run = made.opened(RUN)
        assert run.scene is None
        assert len(run.views) > 0
        assert "not reconstructed yet" in run.state()
        SceneStore.open(copy, "r+").complete("reconstruct", record, RUN)
        made._refresh(run)
        assert run.scene is not None
        assert run.splats is not None
        assert "reconstructed" in run.state()
    finally:
        made.stop()
