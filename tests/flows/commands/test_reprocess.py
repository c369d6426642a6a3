"""Reprocessing of a folder's runs after a change: exactly what it touches is stale, and the old stays until the new is
there. Two methods and two splits of six small photos, with real Prefect runs."""

from __future__ import annotations

import dataclasses
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from flows.cli import app
from flows.commands.reprocess import clone_path, find_stale, make_clone, recover, redo, replace_store
from flows.errors import InputError
from flows.jobs.metric_table import metric_table
from flows.media import images
from flows.pipeline.costs import Costs
from flows.pipeline.sweep import run_sweep
from flows.reporting.summary import timing_rows
from flows.stages import STAGES, render
from schemas.config import SweepConfig, parse_config
from schemas.scene_store import SceneStore
from schemas.tables import read_rows
from tests.flows.pipeline.test_sweep import BASE
from tests.flows.workers.scene import random_model

FITTED = ["reconstruct", "render", "evaluate"]
GENERATED = ["sample", "decode", *FITTED]
PLAIN_RUNS, CAT3D_RUNS = ("v3-zipnerf", "v6-zipnerf"), ("v3-cat3d", "v6-cat3d")


def write_photos(folder: Path) -> None:
    """A nerfstudio folder of eight 24x20 photos, with ReconFusion's split files for 3 and 6 views."""
    from flows.readers.base import read_capture

    capture = read_capture("procedural:dtu/5?views=8&width=24&height=20")
    (folder / "images").mkdir(parents=True)
    frames = []
    for i, name in enumerate(capture.names):
        images.write_png(folder / "images" / f"{name}.png", capture.images[i])
        pose = capture.cameras.world_from_camera[i] @ torch.diag(torch.tensor([1.0, -1, -1, 1], dtype=torch.float64))
        frames.append({"file_path": f"images/{name}.png", "transform_matrix": pose.tolist()})
    k = capture.cameras.intrinsics[0]
    lens = {"fl_x": float(k[0, 0]), "fl_y": float(k[1, 1]), "cx": float(k[0, 2]), "cy": float(k[1, 2])}
    (folder / "transforms.json").write_text(json.dumps(lens | {"w": 24, "h": 20, "frames": frames}))
    write_split(folder, 3, [0, 2, 4], [1, 5])
    write_split(folder, 6, [0, 2, 3, 4, 6, 7], [1, 5])


def write_split(folder: Path, count: int, train: list[int], test: list[int]) -> None:
    (folder / f"train_test_split_{count}.json").write_text(json.dumps({"train_ids": train, "test_ids": test}))


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory, prefect_url: str) -> Path:
    """A folder with `room` (photos), `model.safetensors`, and `out`, a finished sweep over them."""
    root = tmp_path_factory.mktemp("reprocess")
    write_photos(root / "room")
    model = random_model(root / "model.safetensors")
    generated = {"method": "cat3d", "plan": {"views": 4}, "sample": {"checkpoint": str(model), "steps": 1}}
    sweep = {"name": "test", "scenes": [{"source": str(root / "room")}], "splits": ["3", "6"], "base": BASE,
             "methods": {"zipnerf": {"method": "zipnerf"}, "cat3d": generated}}  # fmt: skip
    assert run_sweep(parse_config(sweep, "test", SweepConfig), root / "out") == []
    return root


@pytest.fixture
def root(finished: Path, tmp_path: Path) -> Path:
    """The folder, with what a test may change restored after it; `out` is the test's own copy."""
    kept = tmp_path / "kept"
    shutil.copytree(finished / "room", kept)
    (tmp_path / "out").mkdir()
    shutil.copytree(finished / "out", tmp_path / "out", dirs_exist_ok=True)
    (tmp_path / "room").symlink_to(finished / "room")
    yield tmp_path
    shutil.rmtree(finished / "room")
    shutil.copytree(kept, finished / "room")


def stale_of(out: Path, **options) -> dict[str, list[str]]:
    found, problems = find_stale(out, **options)
    assert not problems
    return {run: [s.stage for s in steps] for stale in found for run, (_, steps) in stale.runs.items()}


def every(plain: list[str], cat3d: list[str]) -> dict[str, list[str]]:
    stages = dict.fromkeys(PLAIN_RUNS, plain) | dict.fromkeys(CAT3D_RUNS, cat3d)
    return {run: names for run, names in stages.items() if names}


def only(split: str, stages: dict[str, list[str]]) -> dict[str, list[str]]:
    return {run: names for run, names in stages.items() if run.startswith(f"v{split}-")}


def one_image(root: Path, monkeypatch: pytest.MonkeyPatch) -> dict:
    images.write_png(root / "room" / "images" / "0002.png", np.zeros((20, 24, 3), np.uint8))
    return every(["ingest", "poses", *FITTED], ["ingest", "poses", "plan", "encode", *GENERATED])


def one_camera(root: Path, monkeypatch: pytest.MonkeyPatch) -> dict:
    document = json.loads((root / "room" / "transforms.json").read_text())
    document["frames"][1]["transform_matrix"][0][3] += 0.01
    (root / "room" / "transforms.json").write_text(json.dumps(document))
    return every(["poses", *FITTED], ["poses", "plan", "encode", *GENERATED])


def one_lens(root: Path, monkeypatch: pytest.MonkeyPatch) -> dict:
    document = json.loads((root / "room" / "transforms.json").read_text())
    (root / "room" / "transforms.json").write_text(json.dumps(document | {"fl_x": document["fl_x"] * 1.01}))
    return every(["ingest", "poses", *FITTED], ["ingest", "poses", "plan", "encode", *GENERATED])


def training_views_of_one_split(root: Path, monkeypatch: pytest.MonkeyPatch) -> dict:
    write_split(root / "room", 3, [0, 2, 3], [1, 5])
    return only("3", every(FITTED, ["plan", *GENERATED]))


def test_views_of_one_split(root: Path, monkeypatch: pytest.MonkeyPatch) -> dict:
    write_split(root / "room", 6, [0, 2, 3, 4, 6, 7], [1])
    return only("6", every(FITTED[1:], FITTED[1:]))


test_views_of_one_split.__test__ = False


def raise_version(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    stages = tuple(dataclasses.replace(one, version=99) if one.name == name else one for one in STAGES)
    monkeypatch.setattr("flows.pipeline.keys.STAGES", stages)


def a_stages_version(root: Path, monkeypatch: pytest.MonkeyPatch) -> dict:
    raise_version("decode", monkeypatch)
    return every([], GENERATED[1:])


def the_last_stages_version(root: Path, monkeypatch: pytest.MonkeyPatch) -> dict:
    raise_version("evaluate", monkeypatch)
    return every(["evaluate"], ["evaluate"])


def a_preset(root: Path, monkeypatch: pytest.MonkeyPatch) -> dict:
    """The shipped settings behind a preset's name, not the name."""
    from dataclasses import replace

    from cat3d_core.zipnerf import PRESETS

    monkeypatch.setitem(PRESETS, "fast", replace(PRESETS["fast"], adam_beta2=0.98))
    return every(FITTED, FITTED)


CHANGES: list[Callable[[Path, pytest.MonkeyPatch], dict]] = [
    one_image, one_camera, one_lens, training_views_of_one_split, test_views_of_one_split, a_stages_version,
    the_last_stages_version, a_preset,
]  # fmt: skip


@pytest.mark.parametrize("change", CHANGES, ids=lambda c: c.__name__)
def test_a_change_of_the_source_or_the_code_makes_exactly_its_stages_stale(root, change, monkeypatch) -> None:
    assert stale_of(root / "out") == {}
    assert stale_of(root / "out") != (expected := change(root, monkeypatch))
    assert stale_of(root / "out") == expected


SETTINGS = {
    "evaluate.protocols": ({"evaluate": {"protocols": ["3dgs"]}}, every(["evaluate"], ["evaluate"])),
    "render.fps": ({"render": {"fps": 24}}, every(["render"], ["render"])),
    "render.test_views": ({"render": {"test_views": False}}, every(FITTED[1:], FITTED[1:])),
    "reconstruct.overrides": ({"reconstruct": {"overrides": {"iterations": 7}}}, every(FITTED, FITTED)),
    "sample.steps": ({"sample": {"steps": 2}}, every([], GENERATED)),
    "plan.views": ({"plan": {"views": 5}}, every([], ["plan", *GENERATED])),
    "ingest.downscale": (
        {"ingest": {"downscale": 2}},
        every(["ingest", "poses", *FITTED], ["ingest", "poses", "plan", "encode", *GENERATED]),
    ),
    "execution.threads": ({"execution": {"threads": 2}}, {}),
}


@pytest.mark.parametrize("setting", SETTINGS)
def test_a_setting_makes_exactly_its_stages_stale(finished: Path, setting: str) -> None:
    changes, expected = SETTINGS[setting]
    assert stale_of(finished / "out", changes=changes) == expected


def test_a_model_with_other_weights_makes_what_used_it_stale(finished: Path, tmp_path: Path) -> None:
    from cat3d_core.diffusion import SIZES, MultiViewModel, load_model, save_model

    torch.manual_seed(1)
    save_model(tmp_path / "other.safetensors", MultiViewModel(SIZES["tiny"]), {})
    shutil.copyfile(finished / "model.safetensors", tmp_path / "same.safetensors")
    further = load_model(finished / "model.safetensors")
    further.unet.conv_in.weight.add_(0.1)
    save_model(tmp_path / "further.safetensors", further, {})
    expected = every([], ["encode", *GENERATED])
    trained_on = every([], GENERATED)  # latents of captured views stay what they are
    for name, stale in (("other", expected), ("same", {}), ("further", trained_on)):
        changes = {"sample": {"checkpoint": str(tmp_path / f"{name}.safetensors")}}
        assert stale_of(finished / "out", changes=changes) == stale


def test_filters_and_from(finished: Path) -> None:
    out = finished / "out"
    assert stale_of(out, from_stage="render") == every(FITTED[1:], FITTED[1:])
    assert stale_of(out, from_stage="render", split="6") == only("6", every(FITTED[1:], FITTED[1:]))
    assert stale_of(out, from_stage="decode", where={"scene": "ro*m"}) == every(FITTED, GENERATED[1:])
    assert stale_of(out, from_stage="evaluate", where={"method": "zipnerf"}) == every(["evaluate"], [])
    assert stale_of(out, from_stage="evaluate", where={"scene": "other*"}) == {}


def invoke(*arguments: str):
    return CliRunner().invoke(app, arguments, env={"COLUMNS": "200"})


def test_dry_run_prints_what_why_and_the_cost_expected_from_earlier_timings(root: Path, monkeypatch) -> None:
    out = root / "out"
    done = invoke("reprocess", str(out), "--dry-run")
    assert (done.exit_code, "Nothing is stale" in done.stdout) == (0, True)
    one_image(root, monkeypatch)
    before = {p: p.stat().st_mtime_ns for p in out.rglob("*")}
    done = invoke("reprocess", str(out), "--dry-run", "--split", "3", "--where", "method=zipnerf")
    assert done.exit_code == 0, done.stdout
    lines = [line for line in done.stdout.splitlines() if "v3-zipnerf" in line]
    assert [line.split("│")[3].strip() for line in lines] == ["ingest", "poses", *FITTED]
    assert "images changed" in lines[0]
    [timing] = [t for t in timing_rows(out) if t["run"] == "v3-zipnerf"]
    assert f"Expected: {timing['total']:.0f} s in all" in done.stdout
    assert {p: p.stat().st_mtime_ns for p in out.rglob("*")} == before, "a dry run writes nothing"
    for arguments in (["--from", "rendering"], ["--where", "colour=red"]):
        assert isinstance(invoke("reprocess", str(out), "--dry-run", *arguments).exception, InputError)


def test_expected_costs_are_the_runs_own_and_for_new_ones_the_median(finished: Path) -> None:
    costs = Costs(finished / "out")
    timings = {t["run"]: t["stages"] for t in timing_rows(finished / "out")}
    for run, stages in timings.items():
        assert {s: costs.own["room", run, s] for s in stages} == stages
    values = sorted(t["sample"] for t in timings.values() if "sample" in t)
    [stale] = find_stale(finished / "out", where={"run": "v3-*"}, from_stage="render")[0]
    job = next(iter(stale.runs.values()))[0]
    new = job.model_copy(update={"config": job.config.model_copy(update={"label": "new"})})
    assert costs.seconds(new, "sample") == pytest.approx(sum(values) / 2)
    assert costs.seconds(new, "no stage") is None


def test_clip_weights_make_only_the_evaluation_stale(root: Path, monkeypatch, prefect_url: str) -> None:
    from safetensors.torch import save_file

    from cat3d_core.metrics.clip import ClipConfig, ClipImageTower

    tower = ClipImageTower(ClipConfig(width=64, layers=1, hidden=64, patch=8, size=16, dimensions=8, heads=1))
    names = {"blocks.0.": "transformer.resblocks.0.", "qkv.": "attn.in_proj_", ".out.": ".attn.out_proj.",
             ".fc.": ".mlp.c_fc.", "0.proj.": "0.mlp.c_proj."}  # fmt: skip
    state = {}
    for key, value in tower.state_dict().items():
        for ours, theirs in names.items():
            key = key.replace(ours, theirs)
        state[f"visual.{key}"] = value
    out, run = root / "out", "v3-zipnerf"
    save_file(state, root / "clip.safetensors")
    assert all(row["clip_score"] is None for row in read_rows(out / "metrics", metric_table()).to_pylist())
    assert any(
        "No CLIP weights" in d.text for d in SceneStore.open(out / "room.zarr").record("evaluate", run).decisions
    )
    monkeypatch.setenv("CAT3D_CLIP_WEIGHTS", str(root / "clip.safetensors"))
    assert stale_of(out) == every(["evaluate"], ["evaluate"])
    redo(find_stale(out)[0])
    for row in read_rows(out / "metrics", metric_table()).to_pylist():
        assert -1 <= row["clip_score"] <= 1
        assert row["clip_network"].startswith("clip-vit-64x1/8-16-quickgelu ")


def test_old_results_stay_until_the_new_are_complete(root: Path, monkeypatch, prefect_url: str) -> None:
    out = root / "out"
    where = {"method": "zipnerf"}
    images.write_png(root / "room" / "images" / "0002.png", np.full((20, 24, 3), 90, np.uint8))
    old_image = SceneStore.open(out / "room.zarr").captured.read("image")
    old_rows = read_rows(out / "metrics", metric_table()).to_pylist()
    execute = render.execute

    def fail_in_the_second_run(job, *rest):
        if job.run == "v6-zipnerf":
            raise RuntimeError("stopped midway")
        return execute(job, *rest)

    replaced = (dataclasses.replace(s, execute=fail_in_the_second_run) if s.name == "render" else s for s in STAGES)
    monkeypatch.setattr("flows.pipeline.keys.STAGES", tuple(replaced))
    pictures = {p: p.read_bytes() for p in out.rglob("*.png")}
    here = {"execution": {"workers": 1}}  # where the replaced stage is
    with pytest.raises(RuntimeError, match="midway"):
        redo(find_stale(out, where=where, changes=here)[0])
    store = SceneStore.open(out / "room.zarr")
    assert np.array_equal(store.captured.read("image"), old_image)
    assert store.record("evaluate", "v3-zipnerf") is not None
    assert read_rows(out / "metrics", metric_table()).to_pylist() == old_rows
    assert all(p.read_bytes() == data for p, data in pictures.items())
    monkeypatch.undo()
    assert stale_of(out, where=where) == {"v6-zipnerf": FITTED[1:]}, "it goes on in the clone"
    redo(find_stale(out, where=where)[0])
    assert [p.name for p in out.glob(".*reprocess*")] == []
    keys = {run: SceneStore.open(out / "room.zarr").record("evaluate", run).key for run in PLAIN_RUNS}
    rows = [r for r in read_rows(out / "metrics", metric_table()).to_pylist() if r["run"] in PLAIN_RUNS]
    assert all(r["key"] == keys[r["run"]] for r in rows)
    assert len(rows) == sum(r["run"] in PLAIN_RUNS for r in old_rows)
    assert any(p.read_bytes() != data for p, data in pictures.items())
    assert (SceneStore.open(out / "room.zarr").captured.read("image", [2]) == 90).all()
    assert stale_of(out, where=where) == {}


@pytest.mark.parametrize("moment", ["before the second rename", "before the old is removed"])
def test_a_kill_during_the_replacement_loses_nothing(tmp_path: Path, moment: str) -> None:
    store = tmp_path / "room.zarr"
    SceneStore.create(store, "room", "test", {})
    make_clone(store, clone_path(store))
    marker = clone_path(store) / "new"
    marker.touch()
    old = tmp_path / ".room.replaced"
    store.rename(old)
    if moment == "before the old is removed":
        clone_path(store).rename(store)
    recover(tmp_path)
    assert SceneStore.open(store).scene_id == "room"
    assert (store / "new").exists()
    assert not old.exists()
    make_clone(store, clone_path(store))
    replace_store(store, clone_path(store))
    assert (store / "new").exists()
