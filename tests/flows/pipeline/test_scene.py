"""The scene flow, run for real: results, nothing done twice, what is redone after a change, kills and resumption."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest

from flows.jobs.metric_table import metric_table
from flows.jobs.request import Request, make_config
from flows.pipeline.keys import pending
from schemas.scene_store import SceneStore
from schemas.tables import TIMINGS, read_rows
from tests.flows.conftest import ROOT, SCENE, TINY, command, environment

RUN = "v3-zipnerf"
STAGES = ["ingest", "poses", "reconstruct", "render", "evaluate"]


@pytest.fixture(scope="module")
def finished(tmp_path_factory, prefect_url) -> Path:
    out = tmp_path_factory.mktemp("finished")
    subprocess.run(command("run", SCENE, "--out", str(out), *TINY), cwd=ROOT, env=environment(), check=True)
    return out


def store_of(out: Path) -> SceneStore:
    return SceneStore.open(out / "procedural_dtu_3.zarr")


def results(out: Path) -> dict[str, np.ndarray]:
    run = store_of(out).run(RUN)
    field = {name: run.field.read(name) for name in run.field.attrs["parameters"]}
    renders = {n: run.renders("test").read(n) for n in ("image", "depth")}
    return field | renders


def executed(out: Path) -> list[str]:
    return [row["stage"] for row in read_rows(out / "timings", TIMINGS).to_pylist()]


def test_one_command_leaves_a_store_metrics_pictures_and_a_report(finished: Path) -> None:
    store = store_of(finished)
    assert [s for s in STAGES if store.record(s, RUN)] == STAGES
    assert store.captured.read("image").shape == (9, 24, 32, 3)
    rows = read_rows(finished / "metrics", metric_table()).to_pylist()
    assert sorted(r["view"] for r in rows) == [0, 8]
    assert all(r["protocol"] == "google" and 5 < r["psnr_db"] < 60 and r["ssim"] <= 1 for r in rows)
    pictures = {p.name for p in (finished / "procedural_dtu_3" / RUN).iterdir()}
    assert {"path.mp4", "path_depth.mp4", "test_0000.png", "test_0000_depth.png"} <= pictures
    page = (finished / "report.html").read_text()
    assert "procedural_dtu_3" in page
    assert "Skipped pose estimation: the cameras are given." in page
    assert "http" not in page.replace("http://www.w3.org", "").replace("https://matplotlib.org", "").replace(
        "http://purl.org", ""
    ).replace("http://creativecommons.org", ""), "the page must not load anything from elsewhere"
    assert sorted(executed(finished)) == sorted(STAGES)


def test_poses_in_the_store_are_normalised_and_invertible(finished: Path) -> None:
    from flows.jobs.access import read_cameras, read_similarity
    from flows.readers.base import read_capture

    store = store_of(finished)
    back = read_similarity(store).inverse().cameras(read_cameras(store.captured))
    given = read_capture(SCENE).cameras
    assert np.allclose(back.world_from_camera.numpy(), given.world_from_camera.double().numpy(), atol=1e-6)


def test_second_run_does_nothing_and_says_so(finished: Path, cat3d) -> None:
    before = executed(finished)
    done = cat3d("run", SCENE, "--out", str(finished), *TINY)
    assert "nothing to do" in done.stdout
    assert executed(finished) == before


@pytest.mark.parametrize(
    ("change", "stale"),
    [
        (["--set", "evaluate.protocols=[google, nerfbaselines]"], ["evaluate"]),
        (["--set", "render.path_views=3"], ["render"]),
        (["--downscale", "2"], STAGES),
        (["--set", "poses.normalize=false"], STAGES[1:]),
    ],
)
def test_a_changed_setting_makes_exactly_its_stages_stale(finished: Path, change: list[str], stale: list[str]) -> None:
    settings = [v for flag, v in zip(TINY[::2], TINY[1::2]) if flag == "--set"]
    given = {"downscale": 1, "method": "auto", "preset": "fast", "seed": 0}
    if change[0] == "--set":
        settings.append(change[1])
    else:
        given["downscale"] = int(change[1])
    steps = pending(Request(SCENE, finished, ("3",), make_config(given, None, settings)).jobs()[0])
    assert [s.stage for s in steps] == stale
    assert all("changed" in s.why for s in steps)


def test_inspect_reports_stages_and_finds_a_flipped_byte(finished: Path, cat3d, tmp_path: Path) -> None:
    import shutil

    copy = tmp_path / "copy.zarr"
    shutil.copytree(finished / "procedural_dtu_3.zarr", copy)
    report = json.loads(cat3d("inspect", str(copy), "--verify", "--json").stdout)
    assert report["ok"]
    chunk = next(p for p in sorted((copy / "captured/image").rglob("*")) if p.is_file() and p.name != "zarr.json")
    data = bytearray(chunk.read_bytes())
    data[len(data) // 2] ^= 1
    chunk.write_bytes(bytes(data))
    damaged = cat3d("inspect", str(copy), "--verify", check=False)
    assert damaged.returncode == 1
    assert "captured/image" in damaged.stdout


@pytest.mark.slow
def test_killed_at_random_moments_it_ends_with_the_uninterrupted_result(finished: Path, tmp_path: Path) -> None:
    """SIGKILL, SIGTERM and SIGINT at random moments; no server is left; the last run completes with equal results."""
    rng = random.Random(0)
    arguments = command("run", SCENE, "--out", str(tmp_path), *TINY)
    own_server = {k: v for k, v in environment().items() if k != "PREFECT_API_URL"}
    for kind in (signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGKILL, signal.SIGKILL, signal.SIGTERM):
        process = subprocess.Popen(
            arguments, cwd=ROOT, env=own_server, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
        )
        time.sleep(rng.uniform(2, 25))
        process.send_signal(kind)
        _, errors = process.communicate(timeout=60)
        time.sleep(1)
        assert not servers_of(tmp_path), "a Prefect server outlived its command"
        if process.returncode in (130, 143):
            assert b"run the same command again" in errors
    done = subprocess.run(arguments, cwd=ROOT, env=own_server, capture_output=True, text=True, timeout=280)
    assert done.returncode == 0, done.stdout + done.stderr
    expected = results(finished)
    actual = results(tmp_path)
    assert expected.keys() == actual.keys()
    for name, value in expected.items():
        assert np.array_equal(actual[name], value), name
    assert max(executed(tmp_path).count(s) for s in STAGES) == 1, "a completed stage ran again"


def servers_of(out: Path) -> list[str]:
    """Command lines of Prefect servers whose home is in `out`."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                environment = (entry / "environ").read_bytes()
                line = (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode()
            except OSError:
                continue
            if str(out).encode() in environment and "prefect.server" in line:
                found.append(line)
    return found


def test_only_one_command_writes_a_store(tmp_path: Path) -> None:
    from flows.errors import InputError
    from flows.locks import writing

    busy = pytest.raises(InputError, match=f"process {os.getpid()}.*is writing")
    with writing(tmp_path / "s.zarr", "s"), busy, writing(tmp_path / "s.zarr", "s"):
        pass


@pytest.mark.parametrize(
    ("arguments", "code", "sentence"),
    [
        (["run", "/nonexistent"], 1, "/nonexistent does not exist; give the folder of a scene."),
        (["run", SCENE, "--views", "7"], 1, "has no split for 7 views"),
        (["run", "procedural:moon/1"], 1, "moon"),
        (["run", SCENE, "--set", "render.frames=3"], 1, "frames is not a setting"),
        (["run", SCENE, "--set", "nonsense"], 1, "write it as NAME=VALUE"),
        (["run", SCENE, "--preset", "best"], 1, "reconstruct.preset: 'best' is none of zipnerf's"),
        (["run", SCENE, "--reader", "magic"], 1, 'There is no reader "magic"'),
        (["run", SCENE, "--set", "reconstruct.overrides={speed: 3}"], 1, "speed is not a setting of the trainer"),
        (["inspect", "/nonexistent.zarr"], 1, "does not exist"),
        (["sweep", "procedural", "--out", "gs://bucket/x"], 1, "gs://bucket/x is not on a file system"),
        (["demo", "--out", "s3://bucket/x"], 1, "s3://bucket/x is not on a file system, and this command needs"),
        (["reprocess", "gs://bucket"], 1, "gs://bucket is not on a file system"),
        (["sweep", "procedural", "--set", "execution.workers=few"], 1, "execution.workers is 'few'"),
        (["run"], 2, "Give the scene's folder, or --prompt"),
        (["fly"], 2, "No such command"),
    ],
)
def test_bad_requests_end_in_a_sentence_and_an_exit_code(
    arguments, code: int, sentence: str, tmp_path: Path, capsys
) -> None:
    from unittest import mock

    from flows import cli

    where = ["--out", str(tmp_path)] if len(arguments) > 1 and arguments[0] == "run" else []
    with mock.patch("sys.argv", ["cat3d", *arguments, *where]), pytest.raises(SystemExit) as stopped:
        cli.main()
    captured = capsys.readouterr()
    assert stopped.value.code == code
    assert sentence in " ".join((captured.out + captured.err).replace("│", " ").split())
    assert "Traceback" not in captured.err


def test_auto_generates_views_for_a_single_photo_only(tmp_path: Path) -> None:
    jobs = Request(SCENE, tmp_path, ("1", "3", "all"), make_config({}, None, [])).jobs()
    assert [j.run for j in jobs] == ["v1-cat3d", "v3-zipnerf", "vall-zipnerf"]
    asked = Request(SCENE, tmp_path, ("3",), make_config({"method": "cat3d"}, None, [])).jobs()
    assert asked[0].run == "v3-cat3d"


def test_the_sampler_is_the_runs_own_else_the_models_else_the_measured_default(tmp_path: Path) -> None:
    from cat3d_core.diffusion import SIZES, MultiViewModel, save_model
    from flows.generation.sampling import sampler_settings

    measured = {"solver": "unipc", "nodes": "log_snr", "steps": 10, "guidance": 3.0}
    paper = {"solver": "ddim", "nodes": "trailing", "steps": 50, "guidance": 3.0}
    advice = {"solver": "ddim", "nodes": "trailing", "steps": 4, "guidance": 1.0}
    for name, provenance in {"plain": {}, "advised": {"sampler": advice}}.items():
        save_model(tmp_path / f"{name}.safetensors", MultiViewModel(SIZES["tiny"]), provenance)

    def chosen(name: str, *settings: str) -> dict:
        given = {"method": "cat3d", "model": str(tmp_path / f"{name}.safetensors")}
        return sampler_settings(Request(SCENE, tmp_path, ("3",), make_config(given, None, settings)).jobs()[0])

    skipped = {"guidance_log_snr": [None, 2.0], "near_steps": False}
    assert chosen("plain") == measured | skipped
    everything = {"guidance_log_snr": [None, None], "near_steps": False}
    assert chosen("advised") == advice | everything, "without guidance there is no interval of it"
    assert chosen("advised", "sample.steps=9") == advice | {"steps": 9} | everything
    assert chosen("plain", "skip=none") == paper | everything
    assert chosen("plain", "skip=none", "sample.guidance_log_snr=[-5, 2]") == paper | everything
