"""`cat3d view` of a folder, from its start to Ctrl-C: runs and results as they appear, keyframes as files, who may
connect."""

from __future__ import annotations

import json
import shutil
import signal
import socket
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import torch

from flows.commands.view import view_command
from flows.errors import InputError
from flows.exports.path import read_path
from flows.jobs.request import Request, make_config
from flows.pipeline.runner import opened, run_missing
from flows.reporting.content import captured_views
from flows.viewer.keyframes import as_bytes, nerfstudio_document, path_document, smooth_path
from flows.viewer.run import OpenRun
from flows.viewer.server import HOST, Viewer, run_names
from schemas.scene_store import SceneStore
from tests.e2e.browser import chromium, free_port, until
from tests.flows.conftest import ROOT, environment

SCENE = "procedural:co3d/1?views=12&width=32&height=24"
RUN = "vall-splats"


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of splats, made without a server."""
    out = tmp_path_factory.mktemp("view")
    settings = ["reconstruct.method=splats", "reconstruct.preset=tiny", "reconstruct.overrides={iterations: 20}"]
    config = make_config({"method": "zipnerf"}, None, [*settings, "render.path=none"])
    [job] = Request(SCENE, out, ("all",), config).jobs()
    with opened(job):
        run_missing(job, until="evaluate")
    assert job.run == RUN
    return job.store_path


def test_keyframes_become_paths_that_export_reads(store: Path, tmp_path: Path) -> None:
    """Ours and nerfstudio's say the same cameras, in the frame of the data set."""
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


@contextmanager
def served(store: Path, *options: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """`cat3d view` of a store's folder in a process of its own, and the address that it printed."""
    command = [sys.executable, "-m", "flows.cli", "view", str(store.parent), "--port", str(free_port()), *options]
    process = subprocess.Popen(command, cwd=ROOT, env=environment(), stdout=subprocess.PIPE, text=True)

    def address() -> str:
        line = process.stdout.readline() if process.stdout else ""
        return line.split()[0] if "Ctrl-C ends it" in line else ""

    try:
        yield process, until(address, every=0)
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=60) == 0
    finally:
        process.kill()


def test_the_command_listens_on_loopback_only_and_ends_with_ctrl_c(store: Path) -> None:
    with served(store) as (_, address):
        assert address.startswith(f"http://{HOST}:")
        port = int(address.rpartition(":")[2])
        page = urllib.request.urlopen(address, timeout=60).read()
        assert b"<html" in page
        addresses = {info[4][0] for info in socket.getaddrinfo(socket.gethostname(), port, socket.AF_INET)}
        for other in addresses - {HOST}:
            if not str(other).startswith("127."):
                with pytest.raises(OSError):
                    socket.create_connection((str(other), port), timeout=5)


@pytest.mark.slow
def test_further_than_loopback_a_browser_needs_the_token(store: Path, tmp_path: Path) -> None:
    with served(store, "--host", "0.0.0.0") as (_, address), chromium(tmp_path / "profile") as browser:
        address = address.replace(socket.gethostname(), HOST)
        base, _, token = address.partition("?token=")
        assert len(token) >= 20
        stranger = browser.open(base)
        until(lambda: "with its token" in stranger.run("document.body?.innerText ?? ''"))
        guest = browser.open(address)
        until(lambda: RUN in guest.run("[...document.querySelectorAll('input')].map(i => i.value).join()"))
        assert "token" not in guest.run("location.href")


def test_what_cannot_be_shown(store: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds no scene store"):
        run_names(tmp_path)
    with pytest.raises(InputError, match=f"has no run other to show; its runs are: {RUN}"):
        Viewer(store, "other", free_port())
    with pytest.raises(InputError, match="--port is 0"):
        view_command(store, None, 0)
    with pytest.raises(InputError, match=r"--host is 192\.0\.2\.1, which is no address of this machine"):
        view_command(store, None, 8080, "192.0.2.1")


def test_a_folder_lists_its_runs_and_their_numbers_sorted(store: Path) -> None:
    made = Viewer(store.parent, None, free_port())
    try:
        assert made.names == [f"procedural_co3d_1 / {RUN}"]
        assert made.table is not None
        psnr_column = next(name for name in made.table.columns if "PSNR" in name)
        assert RUN in made.table.html(psnr_column, rising=False)
        assert made.table.runs == tuple(made.names)
        assert made.opened(made.table.runs[0]).scene is not None
    finally:
        made.stop()


def test_a_run_that_is_added_is_offered(store: Path, tmp_path: Path) -> None:
    folder = tmp_path / "out"
    shutil.copytree(store.parent, folder)
    made = Viewer(folder, None, free_port())
    try:
        shutil.copytree(folder / store.name / "runs" / RUN, folder / store.name / "runs" / "vall-splats-s1")
        made._list()
        assert made.names == [f"procedural_co3d_1 / {RUN}", f"procedural_co3d_1 / {RUN}-s1"]
        assert made.opened(made.names[1]).scene is not None
    finally:
        made.stop()


def test_a_store_that_grows_is_followed(store: Path, tmp_path: Path) -> None:
    """Before the reconstruction is finished there are cameras only; afterwards it is there at the next look."""
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
