"""`cat3d view` in a real browser: splats while moving, the reconstruction itself when resting, several browsers."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from flows.commands.export import export_command
from flows.jobs.request import Request, make_config
from flows.media.images import read_image, resize
from flows.pipeline.runner import opened, run_missing
from flows.viewer.cameras import camera_of, place, vertical_fov
from flows.viewer.keyframes import as_bytes, path_document
from flows.viewer.panel import LAYERS
from flows.viewer.server import HOST, Viewer
from flows.viewer.session import Session
from tests.e2e.browser import Browser, Tab, chromium, free_port, until

SCENE = "procedural:co3d/1?views=12&width=48&height=36"
SPLATS, FIELD = "vall-splats", "vall-zipnerf"
WINDOW = 800, 480


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scene reconstructed twice, made without a server."""
    out = tmp_path_factory.mktemp("view")
    fields = "{iterations: 40, batch_rays: 256, samples: [8, 8], grid_max: [32, 64], grid_features: [1, 2], " \
        "interlevel_blur: [0.03], grid_log2_table: 12, warmup_iterations: 4, lpips_weight: 0.0}"  # fmt: skip
    for method, run, overrides in (("splats", SPLATS, "{}"), ("zipnerf", FIELD, fields)):
        settings = [f"reconstruct.method={method}", f"reconstruct.overrides={overrides}", "reconstruct.preset=tiny"]
        config = make_config({"method": "zipnerf"}, None, settings)
        [job] = Request(SCENE, out, ("all",), config).jobs()
        with opened(job):
            run_missing(job, until="reconstruct")
        assert job.run == run
    return job.store_path


@pytest.fixture
def viewer(store: Path) -> Iterator[Viewer]:
    made = Viewer(store, SPLATS, free_port())
    yield made
    made.stop()


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with chromium(tmp_path_factory.mktemp("profile"), *WINDOW) as found:
        yield found


def opened_tab(browser: Browser, viewer: Viewer) -> tuple[Tab, Session]:
    tab = browser.open(f"http://{HOST}:{viewer.port}")
    [session] = rested(viewer)
    return tab, session


def rested(viewer: Viewer, count: int = 1) -> list[Session]:
    """The sessions of so many browsers, once all rest on a picture of full size."""
    until(lambda: len(viewer.sessions) == count)
    sessions = list(viewer.sessions.values())
    until(lambda: all(is_sharp(session) for session in sessions))
    return sessions


def is_sharp(session: Session) -> bool:
    return session.shown_picture is not None and session.shown_picture[1].scale == 1


def show_nothing_but(session: Session, *names: str) -> None:
    for name in LAYERS:
        session.panel.show(name, name in names)
    session.moved()


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(-10 * math.log10(np.square(a.astype(float) / 255 - b.astype(float) / 255).mean() + 1e-12))


@pytest.mark.slow
def test_the_page_needs_no_network_and_rests_on_what_export_writes(
    viewer: Viewer, browser: Browser, tmp_path: Path
) -> None:
    tab, session = opened_tab(browser, viewer)
    names = tab.run("performance.getEntriesByType('resource').map(entry => entry.name)")
    assert [name for name in names if f"{HOST}:{viewer.port}" not in name and not name.startswith("data:")] == []
    until(lambda: _like(tab.screenshot(tmp_path / "shot.png"), session), every=2)
    # A field is slower: a smaller window.
    tab.resize(300, 200)
    session.panel._open(FIELD)
    until(lambda: is_sharp(session) and session.shown_picture[0].camera.size[0].tolist() == [300, 200])  # type: ignore[index]
    wish, picture = session.shown_picture or pytest.fail("It moves again.")
    assert session.run is not None
    assert session.run.frame_from_scene is not None
    assert wish.scene is viewer.opened(FIELD).scene
    (tmp_path / "path.json").write_bytes(as_bytes(path_document(wish.camera, session.run.frame_from_scene)))
    export_command(viewer.path, FIELD, "renders", tmp_path, path_file=tmp_path / "path.json")
    exported = read_image(tmp_path / "renders" / "frame_0000.png")[0]
    assert exported.shape == picture.image.shape
    assert np.abs(exported.astype(int) - picture.image).max() <= 1
    tab.close()


def _like(screen: np.ndarray, session: Session) -> bool:
    """Whether the lower left part of a screen, where neither panel nor notices are, shows the picture that it should:
    to more than 30 dB."""
    if session.shown_picture is None:
        return False
    height, width = screen.shape[:2]
    wanted = resize(session.shown_picture[1].image, width, height)
    part = slice(height // 2, height - 20), slice(20, width // 2)
    found = psnr(screen[part], wanted[part])
    print(f"screen against the picture: {found:.1f} dB")
    return found > 30


@pytest.mark.slow
@pytest.mark.parametrize(("run", "width", "height", "least"), [(SPLATS, 320, 240, 20), (FIELD, 160, 120, 18)])
def test_splats_are_drawn_like_the_reconstruction(
    viewer: Viewer, browser: Browser, run: str, width: int, height: int, least: float
) -> None:
    """The browser's own picture of the splats at three cameras, against the reconstruction's render."""
    tab, session = opened_tab(browser, viewer)
    session.panel._open(run)
    until(lambda: session.run is not None and session.run.splats is not None)
    assert session.run is not None
    assert session.run.scene is not None
    show_nothing_but(session, "splats")
    found = []
    for view in session.run.views[:9:4]:
        wxyz, position = place(view.camera)
        fov = vertical_fov(view.camera)
        drawn = session.client.get_render(
            height, width, wxyz=wxyz, position=position, fov=fov, transport_format="png", timeout=120
        )
        ours = session.run.scene.render(camera_of(wxyz, position, fov, width, height).to(dtype=torch.float32), 0)
        found.append(psnr(drawn[..., :3], ours.image.numpy() * 255))
    print(f"splats of {run} in the browser against its render: {[round(value, 1) for value in found]} dB")
    assert min(found) > least
    tab.close()


@pytest.mark.slow
def test_moving_shows_splats_and_two_browsers_do_not_disturb_each_other(viewer: Viewer, browser: Browser) -> None:
    tabs = [browser.open(f"http://{HOST}:{viewer.port}") for _ in range(2)]
    one, two = rested(viewer, 2)
    for session in (one, two):
        show_nothing_but(session, "reconstruction", "splats")
    rested(viewer, 2)
    places = {session: session.client.camera.position.copy() for session in (one, two)}
    # Which tab is whose does not matter: the one that is dragged moves, the other does not.
    tabs[0].drag((250, 300), (80, 20))

    def has_moved(session: Session) -> bool:
        return float(np.linalg.norm(session.client.camera.position - places[session])) > 1e-3

    until(lambda: has_moved(one) or has_moved(two))
    moved, still = (one, two) if has_moved(one) else (two, one)
    assert is_sharp(still)
    assert not has_moved(still)
    until(lambda: is_sharp(moved))
    for tab in tabs:
        tab.close()


@pytest.mark.slow
def test_a_click_flies_to_a_camera_and_runs_can_be_compared(viewer: Viewer, browser: Browser) -> None:
    tab, session = opened_tab(browser, viewer)
    show_nothing_but(session, "captured")
    assert session.run is not None
    target = session.run.views[5]
    behind = target.camera.world_from_camera[0, :3, 3] - 0.5 * target.camera.world_from_camera[0, :3, 2]
    pose = target.camera.world_from_camera.clone()
    pose[0, :3, 3] = behind
    session.fly(type(target.camera)(target.camera.intrinsics, pose, target.camera.size))
    until(lambda: np.allclose(session.client.camera.position, behind, atol=1e-3))
    rows, columns = tab.run("[innerHeight, innerWidth]")

    def flown() -> bool:
        tab.click(columns / 2, rows / 2)
        return np.allclose(session.client.camera.position, place(target.camera)[1], atol=1e-3)

    until(flown, every=1)
    until(lambda: session.panel._beside_image is not None)
    assert session.panel._beside_text.content == f"**{target.name}**: photo | rendered"
    # A comparison: splats to the left, the field to the right, each as it renders.
    tab.resize(300, 200)
    session.panel._other.value = FIELD
    session.panel.show("reconstruction", True)
    session.moved()
    until(lambda: is_sharp(session) and session.shown_picture[0].other is not None)  # type: ignore[index]
    wish, picture = session.shown_picture or pytest.fail("It moves again.")
    half = picture.image.shape[1] // 2
    for scene, columns in ((wish.scene, slice(0, half)), (wish.other, slice(half, None))):
        assert scene is not None
        whole = scene.render(wish.camera.to(dtype=torch.float32), 0).image.numpy() * 255
        assert np.abs(picture.image[:, columns] - whole[:, columns]).max() < 1.01
    tab.close()
