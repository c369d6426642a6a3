"""Environments of companies and containers: a proxy, no home, settings of Prefect for another server."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from flows import disk
from flows.errors import describe
from flows.media.images import write_png
from flows.pipeline.server import quiet_environment
from schemas.errors import StoreError
from schemas.scene_store import SceneStore
from tests.flows.conftest import ROOT

SCENE = "procedural:llff/2?views=5&width=24&height=20"


def run(
    source: str, out: Path | str, environment: dict[str, str] | None = None, cwd: Path | None = None
) -> subprocess.CompletedProcess[str]:
    """`cat3d run`, as small as it gets, in a process of its own."""
    command = [
        sys.executable, "-m", "flows.cli", "run", source, "--out", str(out), "--views", "3",
        "--preset", "tiny", "--set", "render.path=none", "--set", "evaluate.lpips=false",
        "--set", "reconstruct.overrides={iterations: 4, warmup_iterations: 1}",
    ]  # fmt: skip
    if environment is None:  # with a server of its own, on the disk of its results
        own = {name: value for name, value in os.environ.items() if not name.startswith("PREFECT_")}
        environment = own | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    return subprocess.run(
        command, env=environment, cwd=cwd or ROOT, capture_output=True, text=True, encoding="utf-8", errors="replace",
        timeout=280,
    )  # fmt: skip


@contextlib.contextmanager
def small_disk(folder: Path, size: str) -> Iterator[None]:
    """A disk of its own at `folder`; skips where this user may not mount one."""
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)]
    if shutil.which("mount") is None or subprocess.run(mount, capture_output=True).returncode:
        pytest.skip("This user may not mount a small disk, on which it could be seen what a full one does.")
    try:
        yield
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


def remount(folder: Path, options: str) -> None:
    subprocess.run(["mount", "-o", f"remount,{options}", str(folder)], check=True)


def results(out: Path) -> dict[str, np.ndarray]:
    """What a run of SCENE stored of pictures and numbers."""
    store = SceneStore.open(next(out.glob("*.zarr")))
    (name,) = store.runs()
    run = store.run(name)
    return {"image": run.renders("test").read("image"), "depth": run.renders("test").read("depth"),
            "photos": store.captured.read("image")}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("left", [100, 3500], ids=["no room for the database", "no room for the results"])
def test_a_full_disk_is_named_and_the_rerun_ends_with_equal_bits(tmp_path: Path, left: int) -> None:
    out = tmp_path / "disk" / "out"
    with small_disk(tmp_path / "disk", "32m"):
        (tmp_path / "disk" / "filler").write_bytes(bytes((32 * 1024 - left) * 1024))
        done = run(SCENE, out)
        said = " ".join(done.stderr.split())
        assert done.returncode == 1, done.stdout
        assert f"The disk {tmp_path}/disk, on which {out} is, is full" in said
        assert "Traceback" not in said
        assert "500" not in said
        (tmp_path / "disk" / "filler").unlink()
        again = run(SCENE, out)
        assert again.returncode == 0, again.stderr
        found = results(out)
    other = run(SCENE, tmp_path / "elsewhere")
    assert other.returncode == 0, other.stderr
    for name, values in results(tmp_path / "elsewhere").items():
        assert np.array_equal(values, found[name]), name


@pytest.mark.slow
def test_a_home_that_cannot_be_written_does_and_an_out_that_cannot_is_a_sentence(tmp_path: Path) -> None:
    with small_disk(tmp_path / "disk", "64m"):
        (tmp_path / "disk" / "home").mkdir()
        remount(tmp_path / "disk", "ro")
        home = {"HOME": str(tmp_path / "disk" / "home"), "PYTHONPATH": str(ROOT), "PATH": os.environ["PATH"],
                "OMP_NUM_THREADS": "1"}  # fmt: skip
        done = run(SCENE, tmp_path / "out", home)
        assert done.returncode == 0, done.stderr
        done = run(SCENE, tmp_path / "disk" / "out")
        assert done.returncode == 1
        assert done.stderr.startswith("cat3d: ")
        assert "Read-only file system" in done.stderr
        assert "Traceback" not in done.stderr


@pytest.mark.slow
def test_umlauts_in_the_locale_c_with_an_ascii_terminal_from_another_folder(tmp_path: Path) -> None:
    """Names are found, and stand in the report as they are, though this Python knows ASCII alone."""
    scene = tmp_path / "Küche (Süd)"
    scene.mkdir()
    for i in range(4):
        write_png(scene / f"Löffel {i}.png", np.full((20, 24, 3), 60 * i, np.uint8))
    poses = [np.eye(4) + np.array([[0, 0, 0, 0.1 * i], [0] * 4, [0, 0, 0, 2], [0] * 4]) for i in range(4)]
    frames = [{"file_path": f"Löffel {i}.png", "transform_matrix": pose.tolist()} for i, pose in enumerate(poses)]
    cameras = {"camera_angle_x": 0.8, "frames": frames}
    (scene / "transforms.json").write_text(json.dumps(cameras), encoding="utf-8")
    plain = {"PATH": os.environ["PATH"], "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "HOME": str(tmp_path),
             "LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0", "PYTHONIOENCODING": "ascii"}  # fmt: skip
    done = run("Küche (Süd)", "Ergebnisse", plain, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.isascii()
    out = tmp_path / "Ergebnisse"
    assert "Küche (Süd)" in (out / "report.html").read_text(encoding="utf-8")
    (store,) = (SceneStore.open(path) for path in out.glob("*.zarr"))
    assert store.captured.read("name").tolist() == [f"Löffel {i}.png" for i in range(4)]
    for command in (["inspect", str(store.root)], ["reprocess", str(out), "--dry-run"]):
        done = subprocess.run([sys.executable, "-m", "flows.cli", *command], env=plain, cwd="/", capture_output=True)
        assert done.returncode == 0, done.stderr
        assert b"changed" not in done.stdout


def test_what_failed_on_a_full_disk_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    failure = RuntimeError("a task failed")
    failure.__cause__ = OSError(errno.ENOSPC, "No space left on device", "chunk")
    with pytest.raises(StoreError, match=r"The disk /.*, on which .* is, is full"), disk.naming_full_disk(tmp_path):
        raise failure
    with pytest.raises(RuntimeError, match="another"), disk.naming_full_disk(tmp_path / "not" / "there"):
        raise RuntimeError("another")
    monkeypatch.setattr(disk, "FULL_BYTES", 2**62)  # whatever is free is too little
    with pytest.raises(StoreError, match="are free"), disk.naming_full_disk(tmp_path):
        raise RuntimeError("Server error '500 Internal Server Error'")


def test_this_machine_is_reached_without_the_proxy(monkeypatch, tmp_path: Path) -> None:
    monkeypatch.setenv("NO_PROXY", "intern.example, 10.0.0.0/8")
    monkeypatch.delenv("no_proxy", raising=False)
    environment = quiet_environment(tmp_path)
    assert environment["NO_PROXY"] == environment["no_proxy"] == "intern.example,10.0.0.0/8,127.0.0.1,localhost"


def test_a_run_behind_a_proxy_without_a_home_and_with_prefect_settings_of_another_server(tmp_path: Path) -> None:
    """The proxy answers nothing, the base path would move our server's address, and there is no home at all."""
    (tmp_path / "file").write_text("no folder, so that no home can be made below it")
    environment = {
        "PATH": os.environ["PATH"], "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1",
        "HTTP_PROXY": "http://127.0.0.1:9", "http_proxy": "http://127.0.0.1:9", "ALL_PROXY": "http://127.0.0.1:9",
        "PREFECT_SERVER_API_BASE_PATH": "/elsewhere", "PREFECT_PROFILE": "nobody",
        "HOME": str(tmp_path / "file" / "home"),
    }  # fmt: skip
    done = run(SCENE, tmp_path / "out", environment)
    assert done.returncode == 0, done.stderr[-2000:]
    assert (tmp_path / "out" / "report.html").exists()


def test_a_failing_server_is_a_sentence_with_the_cause() -> None:
    kind = type("PrefectHTTPStatusError", (Exception,), {})
    sentence = describe(kind("Server error '500 Internal Server Error'\nmore"))
    assert sentence is not None
    assert "500 Internal Server Error" in sentence
    assert "full" in sentence
