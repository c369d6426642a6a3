"""A whole run with a tiny random network of SEVA's kind: terms, windows in two passes, killed and resumed."""

from __future__ import annotations

import dataclasses
import os
import shutil
import signal
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest

from cat3d_core.seva.checkpoint import LICENCE
from cat3d_core.seva.config import TINY as SHAPE
from flows.commands.models import model_report
from flows.commands.run import run_command
from flows.errors import InputError
from flows.generation.formats import seva
from flows.generation.open import generator_spec, open_generator, recognised
from flows.generation.opening import opening
from flows.generation.plan import read_plan
from flows.jobs import device
from flows.jobs.request import make_request
from schemas.layout import ROLES
from schemas.scene_store import Run, SceneStore
from tests.core.seva.models import write_seva
from tests.flows.conftest import ROOT, SCENE, TINY, command, environment

SMALL = [
    *TINY, "--method", "cat3d",
    "--set", "plan.views=12", "--set", "sample.steps=2", "--set", "skip={coverage: false, covered_path: false}",
]  # fmt: skip


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_seva(tmp_path_factory.mktemp("seva"), dataclasses.replace(SHAPE, views=8))


@pytest.fixture(scope="module")
def whole(model: Path, prefect_url: str, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A run that nothing disturbed, by one worker, and what it printed."""
    out = tmp_path_factory.mktemp("whole")
    arguments = ["run", SCENE, "--out", str(out), "--model", str(model), *SMALL, "--set", "execution.workers=1"]
    done = subprocess.run(command(*arguments), cwd=ROOT, env=environment(), capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return out, done.stdout


def run_in(out: Path) -> Run:
    (store,) = out.glob("*.zarr")
    return SceneStore.open(store).run("v3-cat3d")


def test_terms_and_memory_are_said_once_and_recorded(whole: tuple[Path, str]) -> None:
    out, printed = whole
    assert " ".join(printed.split()).count(LICENCE) == 1
    assert "Memory: the generator needs" in " ".join(printed.split())
    assert run_in(out).generated.attrs["terms"] == LICENCE
    assert LICENCE.split(":")[0] in (out / "report.html").read_text()


def test_captured_views_are_in_every_window_and_anchors_come_first(whole: tuple[Path, str]) -> None:
    run = run_in(whole[0])
    plan = read_plan(run.plan, 9)
    captured = set(np.flatnonzero(run.read("role") == ROLES["train"]).tolist())
    assert len(captured) == 3
    first, second = plan.passes()
    anchors = {view for g in first for view in plan.groups[g].targets}
    for g in first:
        assert set(plan.groups[g].conditions) == captured
    for g in second:
        conditions = set(plan.groups[g].conditions)
        assert conditions & set(range(9)) == captured
        assert {view - 9 for view in conditions if view >= 9} <= anchors
        assert len(conditions) + len(plan.groups[g].targets) <= 8
    assert (run.generated.read("done_image").any(-1)).all()
    images = run.generated.read("image")
    assert images.shape[1:] == (64, 64, 3)
    assert all(image.std() > 1 for image in images)


@pytest.mark.slow
def test_killed_and_resumed_by_two_workers_it_gives_equal_bits(
    whole: tuple[Path, str], model: Path, prefect_url: str, tmp_path: Path
) -> None:
    arguments = ["run", SCENE, "--out", str(tmp_path), "--model", str(model), *SMALL]
    arguments += ["--set", "execution={workers: 2, batch_seconds: 0.1}", "--set", "skip.workers=false"]
    process = subprocess.Popen(
        command(*arguments), cwd=ROOT, env=environment(), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        start_new_session=True,
    )  # fmt: skip
    deadline = time.monotonic() + 900
    while not any(tmp_path.glob("*.zarr/runs/v3-cat3d/generated/done_latent/c.*")):
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.02)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    before = len(list(tmp_path.glob("*.zarr/runs/v3-cat3d/generated/done_latent/c.*")))
    assert before < 12
    done = subprocess.run(command(*arguments), cwd=ROOT, env=environment(), capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    for name in ("latent", "image"):
        assert np.array_equal(run_in(tmp_path).generated.read(name), run_in(whole[0]).generated.read(name))


def test_model_folders_are_recognised_and_what_is_missing_is_named(model: Path, tmp_path: Path) -> None:
    assert recognised(model) == "seva"
    assert recognised(model / "modelv1.1.safetensors") == "seva"
    report = model_report(model)
    assert (report["generator"], report["views"], report["image_size"]) == ("seva", 8, [64, 64])
    assert report["terms"] == LICENCE
    assert seva.describe(model) == seva.describe(model / "modelv1.1.safetensors")
    for part, sentence in (("vae", "Stable Diffusion 2.1's autoencoder"), ("image_encoder", "OpenCLIP's ViT-H/14")):
        folder = tmp_path / part
        shutil.copytree(model, folder)
        shutil.rmtree(folder / part)
        with pytest.raises(ValueError, match=sentence):
            seva.describe(folder)


def test_another_network_is_another_identity(model: Path, tmp_path: Path) -> None:
    other = write_seva(tmp_path / "other", dataclasses.replace(SHAPE, views=8), seed=1)
    ours, theirs = seva.describe(model), seva.describe(other)
    assert ours.identity != theirs.identity
    assert ours.encoder_identity == theirs.encoder_identity


def test_too_little_memory_is_a_sentence(model: Path, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("flows.generation.opening.available_memory", lambda: 2**20)
    given, settings = {"method": "cat3d", "model": str(model)}, ["execution={workers: 2, groups_at_once: 4}"]
    with pytest.raises(InputError, match=r"Memory is too small: each of 2 workers needs .* What helps: execution") as e:
        run_command(make_request(SCENE, tmp_path, "3", given, settings=settings))
    assert "sample.precision=bfloat16, a smaller plan.window or plan.image_size, a device" in str(e.value)


def test_settings_that_windows_do_not_have_are_refused(cat3d, model: Path, tmp_path: Path) -> None:
    done = cat3d("plan", SCENE, "--out", str(tmp_path), "--model", str(model), "--views", "3",
                 "--set", "plan.group_size=2", check=False)  # fmt: skip
    assert done.returncode == 1
    assert "plan.group_size is set, but this generator's windows of 8 views" in " ".join(done.stderr.split())


def test_windows_and_images_of_other_sizes_are_planned_for(model: Path, tmp_path: Path) -> None:
    """What the plan asks for is the generator's too; a network of one size refuses it."""
    settings = ["plan={window: 6, image_size: 128}"]
    (job,) = make_request(SCENE, tmp_path, "3", {"method": "cat3d", "model": str(model)}, settings=settings).jobs()
    spec = generator_spec(job)
    assert (spec.views, spec.image_size, spec.latent_shape) == (6, (128, 128), (4, 16, 16))
    assert spec.identity == seva.describe(model).identity
    assert "of 6 views at once" in opening(job)[1]
    assert open_generator(job).spec == spec
    (job,) = make_request(SCENE, tmp_path, "3", {"method": "cat3d", "model": str(model)}, settings=[]).jobs()
    assert open_generator(job).spec.views == 8
    (odd,) = make_request(SCENE, tmp_path, "3", {"method": "cat3d", "model": str(model)},
                          settings=["plan.image_size=100"]).jobs()  # fmt: skip
    with pytest.raises(InputError, match="plan.image_size: Images of 100 pixels a side are not multiples of 64"):
        generator_spec(odd)
    (ours,) = make_request(SCENE, tmp_path, "3", {"method": "cat3d"}, settings=["plan.window=6"]).jobs()
    with pytest.raises(InputError, match="plan.window is set, but the generator cat3d always takes 8 views at once"):
        generator_spec(ours)


def test_the_device_is_what_there_is_or_what_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    monkeypatch.setattr("torch.backends.mps.is_available", lambda: True)
    assert device.device() == "mps"
    assert device.exact_device() == "cpu"
    monkeypatch.setenv("CAT3D_DEVICE", "cpu")
    assert device.device() == "cpu"
    monkeypatch.setenv("CAT3D_DEVICE", "cuda")
    with pytest.raises(InputError, match="doesn't have; it has mps, cpu"):
        device.device()
    monkeypatch.delenv("CAT3D_DEVICE")
    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    assert device.device() == "cuda"
    assert device.exact_device() == "cuda"
