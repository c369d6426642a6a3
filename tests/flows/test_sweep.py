"""Sweeps, reprocessing and comparison of results, on scenes of a few small views, with real Prefect runs."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from flows import images
from flows.reprocess import clone_path, find_stale, make_clone, recover, redo, replace_store
from flows.results import compare
from flows.sweep import open_jobs, run_sweep, sweep_jobs
from schemas.config import SweepConfig, merged, parse_config
from schemas.scene_store import SceneStore
from schemas.tables import METRICS, TIMINGS, append_rows, read_rows

TRAINER = {
    "iterations": 6, "batch_rays": 64, "samples": [8, 8], "grid_max": [32, 64], "grid_features": [1, 2],
    "interlevel_blur": [0.03], "grid_log2_table": 10, "warmup_iterations": 2, "lpips_weight": 0.0,
}  # fmt: skip
BASE = {"render": {"path": "none"}, "evaluate": {"lpips": False}, "reconstruct": {"overrides": TRAINER}}


def sweep_of(*sources: str, **changes) -> SweepConfig:
    document = {"name": "test", "scenes": [{"source": s} for s in sources], "splits": ["3"], "base": BASE}
    return parse_config(merged(document, changes), "test", SweepConfig)


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    """A nerfstudio folder of six 24x20 photos on disk, with a ReconFusion split file."""
    from flows.readers.base import read_capture

    capture = read_capture("procedural:dtu/5?views=6&width=24&height=20")
    folder = tmp_path / "room"
    (folder / "images").mkdir(parents=True)
    frames = []
    for i, name in enumerate(capture.names):
        images.write_png(folder / "images" / f"{name}.png", capture.images[i])
        pose = capture.cameras.world_from_camera[i] @ torch.diag(torch.tensor([1.0, -1, -1, 1], dtype=torch.float64))
        frames.append({"file_path": f"images/{name}.png", "transform_matrix": pose.tolist()})
    k = capture.cameras.intrinsics[0]
    lens = {"fl_x": float(k[0, 0]), "fl_y": float(k[1, 1]), "cx": float(k[0, 2]), "cy": float(k[1, 2])}
    document = lens | {"w": 24, "h": 20, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(document))
    (folder / "train_test_split_3.json").write_text(json.dumps({"train_ids": [0, 2, 4], "test_ids": [1, 5]}))
    return folder


def stages_run(out: Path) -> list[tuple[str, str]]:
    return sorted((r["scene_id"], r["stage"]) for r in read_rows(out / "timings", TIMINGS).to_pylist())


def test_a_failed_scene_does_not_stop_the_rest_and_a_rerun_does_nothing(tmp_path: Path, prefect_url: str) -> None:
    broken = tmp_path / "broken"
    broken.mkdir()
    (broken / "transforms.json").write_text("{")
    good = "procedural:llff/2?views=6&width=24&height=20"
    config = sweep_of(str(broken), "$CAT3D_NOT_SET/scene", good, splits=["3", "9"])
    problems = run_sweep(config, tmp_path / "out")
    assert len(problems) == 3
    assert any("transforms.json" in p for p in problems)
    assert any("CAT3D_NOT_SET is not set" in p for p in problems)
    assert any("no split for 9 views" in p for p in problems)
    rows = read_rows(tmp_path / "out" / "metrics", METRICS).to_pylist()
    assert {r["run"] for r in rows} == {"v3-zipnerf"}
    before = stages_run(tmp_path / "out")
    run_sweep(config, tmp_path / "out")
    assert stages_run(tmp_path / "out") == before


def test_ablations_and_seeds_are_runs_of_their_own(tmp_path: Path) -> None:
    methods = {"zipnerf": {}, "no-decay": {"reconstruct": {"overrides": {"weight_decay": 0.0}}}}
    config = sweep_of("procedural:llff/2?views=6&width=24&height=20", methods=methods, seeds=[0, 1])
    scenes, problems = sweep_jobs(config, tmp_path)
    assert not problems
    assert [j.run for j in scenes[0]] == ["v3-zipnerf", "v3-zipnerf-s1", "v3-no-decay", "v3-no-decay-s1"]
    assert scenes[0][2].config.reconstruct.overrides == TRAINER | {"weight_decay": 0.0}


@pytest.mark.parametrize(
    "path", sorted((Path(__file__).parents[2] / "flows" / "sweeps").glob("*.yaml")), ids=lambda p: p.stem
)
def test_shipped_sweeps_are_valid(path: Path) -> None:
    config = parse_config(yaml.safe_load(path.read_text()), path.name, SweepConfig)
    for label, settings in config.methods.items():
        parse_config(merged(config.base, settings, {"label": label}), path.name)


@pytest.fixture
def processed(dataset: Path, tmp_path: Path, prefect_url: str) -> tuple[Path, Path]:
    out = tmp_path / "out"
    assert run_sweep(sweep_of(str(dataset)), out) == []
    return dataset, out


def stale_of(out: Path, **options) -> dict[str, list[str]]:
    found, problems = find_stale(out, **options)
    assert not problems
    return {run: [s.stage for s in steps] for stale in found for run, (_, steps) in stale.runs.items()}


ALL = ["ingest", "poses", "reconstruct", "render", "evaluate"]


def test_each_change_makes_exactly_its_stages_stale(processed: tuple[Path, Path], monkeypatch) -> None:
    dataset, out = processed
    run = "v3-zipnerf"
    assert stale_of(out) == {}
    assert stale_of(out, changes={"evaluate": {"protocols": ["3dgs"]}}) == {run: ["evaluate"]}
    assert stale_of(out, changes={"reconstruct": {"overrides": {"iterations": 7}}}) == {run: ALL[2:]}
    assert stale_of(out, from_stage="render") == {run: ALL[3:]}
    assert stale_of(out, where={"scene": "other*"}) == {}
    assert stale_of(out, split="6") == {}
    image = dataset / "images" / "0002.png"
    original = image.read_bytes()
    images.write_png(image, np.zeros((20, 24, 3), np.uint8))
    assert stale_of(out) == {run: ALL}
    image.write_bytes(original)
    assert stale_of(out) == {}
    split = dataset / "train_test_split_3.json"
    before = split.read_text()
    split.write_text(json.dumps({"train_ids": [0, 2, 3], "test_ids": [1, 5]}))
    assert stale_of(out) == {run: ALL[2:]}
    split.write_text(json.dumps({"train_ids": [0, 2, 4], "test_ids": [1]}))
    assert stale_of(out) == {run: ALL[3:]}
    split.write_text(before)
    cameras = json.loads((dataset / "transforms.json").read_text())
    cameras["frames"][1]["transform_matrix"][0][3] += 0.01
    (dataset / "transforms.json").write_text(json.dumps(cameras))
    assert stale_of(out) == {run: ALL[1:]}
    from flows.stages import render

    cameras["frames"][1]["transform_matrix"][0][3] -= 0.01
    (dataset / "transforms.json").write_text(json.dumps(cameras))
    monkeypatch.setattr(render, "VERSION", 99)
    found, _ = find_stale(out)
    assert "code version" in found[0].runs[run][1][0].why


def test_clip_weights_and_protocols_make_only_the_evaluation_stale(processed: tuple[Path, Path], monkeypatch) -> None:
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
    _, out = processed
    save_file(state, out.parent / "clip.safetensors")
    run = "v3-zipnerf"
    assert read_rows(out / "metrics", METRICS).to_pylist()[0]["clip_score"] is None
    assert any("No CLIP weights" in d for d in SceneStore.open(out / "room.zarr").record("evaluate", run).decisions)
    monkeypatch.setenv("CAT3D_CLIP_WEIGHTS", str(out.parent / "clip.safetensors"))
    assert stale_of(out) == {run: ["evaluate"]}
    redo(find_stale(out)[0])
    for row in read_rows(out / "metrics", METRICS).to_pylist():
        assert -1 <= row["clip_score"] <= 1
        assert row["clip_network"].startswith("clip-vit-64x1/8-16-quickgelu ")


def test_old_results_stay_until_the_new_are_complete(processed: tuple[Path, Path], monkeypatch) -> None:
    dataset, out = processed
    images.write_png(dataset / "images" / "0002.png", np.full((20, 24, 3), 90, np.uint8))
    old_image = SceneStore.open(out / "room.zarr").captured.read("image")
    from flows.stages import render

    def fail(*_: object) -> None:
        raise RuntimeError("stopped midway")

    monkeypatch.setattr(render, "execute", fail)
    with pytest.raises(RuntimeError, match="midway"):
        redo(find_stale(out)[0])
    store = SceneStore.open(out / "room.zarr")
    assert np.array_equal(store.captured.read("image"), old_image)
    assert store.record("evaluate", "v3-zipnerf") is not None
    monkeypatch.undo()
    assert stale_of(out) == {"v3-zipnerf": ["render", "evaluate"]}, "it goes on in the clone"
    redo(find_stale(out)[0])
    assert not clone_path(out / "room.zarr").exists()
    assert (SceneStore.open(out / "room.zarr").captured.read("image", [2]) == 90).all()
    assert stale_of(out) == {}


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


def test_results_name_regressions_beyond_the_bound(tmp_path: Path) -> None:
    row = {"scene_id": "a", "run": "v3-zipnerf", "key": "k", "protocol": "google", "view": 0, "width": 8, "height": 8,
           "psnr_db": 20.0, "ssim": 0.5, "lpips": 0.3, "lpips_backbone": "lpips-vgg", "method": "zipnerf"}  # fmt: skip
    for name, changes in {"old": {}, "worse": {"psnr_db": 19.8}, "fine": {"psnr_db": 19.95, "ssim": 0.6},
                          "other": {"lpips": 0.9, "lpips_backbone": "st-lpips-alex"}}.items():  # fmt: skip
        append_rows(tmp_path / name / "metrics", METRICS, [row | changes], "a")
    assert compare(tmp_path / "worse", tmp_path / "old", 0.1, 0.01) == 1
    assert compare(tmp_path / "fine", tmp_path / "old", 0.1, 0.01) == 0
    assert compare(tmp_path / "other", tmp_path / "old", 0.1, 0.01) == 0


def test_open_jobs_is_empty_only_when_everything_is_stored(processed: tuple[Path, Path]) -> None:
    dataset, out = processed
    scenes, _ = sweep_jobs(sweep_of(str(dataset)), out)
    assert open_jobs(scenes[0]) == []
    shutil.rmtree(out / "room.zarr")
    assert open_jobs(scenes[0]) == scenes[0]


def test_runs_of_one_scene_do_not_undo_each_other(tmp_path: Path, prefect_url: str) -> None:
    """Found in the demo: encoding for the second method took back the records of the first one's later stages."""
    from cat3d_core.diffusion import SIZES, MultiViewModel, save_model

    model = tmp_path / "tiny.safetensors"
    save_model(model, MultiViewModel(SIZES["tiny"]), {})
    generated = {"method": "cat3d", "plan": {"views": 3}, "sample": {"checkpoint": str(model), "steps": 2}}
    methods = {"zipnerf": {"method": "zipnerf"}, "cat3d": generated}
    config = sweep_of("procedural:llff/2?views=6&width=24&height=20", methods=methods)
    assert run_sweep(config, tmp_path / "out") == []
    scenes, _ = sweep_jobs(config, tmp_path / "out")
    assert open_jobs(scenes[0]) == []
