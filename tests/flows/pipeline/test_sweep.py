"""Sweeps and comparison of results, on scenes of a few small views, with real Prefect runs."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest
import yaml
from typer.testing import CliRunner

from flows.cli import app
from flows.commands.results import compare
from flows.commands.sweep import with_settings
from flows.jobs.metric_table import metric_table
from flows.pipeline.sweep import open_jobs, run_sweep, sweep_jobs
from schemas.config import SceneSource, SweepConfig, load_config, parse_config
from schemas.settings import merged
from schemas.tables import TIMINGS, append_rows, read_rows
from tests.flows.conftest import ROOT, command, environment
from tests.flows.workers.scene import random_model

TRAINER = {
    "iterations": 6, "batch_rays": 64, "samples": [8, 8], "grid_max": [32, 64], "grid_features": [1, 2],
    "interlevel_blur": [0.03], "grid_log2_table": 10, "warmup_iterations": 2, "lpips_weight": 0.0,
}  # fmt: skip
BASE = {"render": {"path": "none"}, "evaluate": {"lpips": False}, "reconstruct": {"overrides": TRAINER}}


def sweep_of(*sources: str, **changes) -> SweepConfig:
    document = {"name": "test", "scenes": [{"source": s} for s in sources], "splits": ["3"], "base": BASE}
    return parse_config(merged(document, changes), "test", SweepConfig)


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
    assert any("set the environment variable CAT3D_NOT_SET" in p for p in problems)
    assert any("no split for 9 views" in p for p in problems)
    rows = read_rows(tmp_path / "out" / "metrics", metric_table()).to_pylist()
    assert {r["run"] for r in rows} == {"v3-zipnerf"}
    before = stages_run(tmp_path / "out")
    run_sweep(config, tmp_path / "out")
    assert stages_run(tmp_path / "out") == before


def test_patterns_take_every_scene_there_is_and_missing_ones_say_where_to_get_them(tmp_path: Path) -> None:
    from tests.flows.commands.test_reprocess import write_photos

    for name in ("b", "a"):
        write_photos(tmp_path / "data" / name)
    config = sweep_of(f"{tmp_path}/data/*", splits=["3", "6"])
    scenes, problems = sweep_jobs(config, tmp_path)
    assert [(j.scene_id, j.config.split) for jobs in scenes for j in jobs] == [(s, n) for s in "ab" for n in "36"]
    assert not problems
    for source in (f"{tmp_path}/none/*", f"{tmp_path}/none", "$CAT3D_NOT_SET/x"):
        scene = {"source": source, "obtain": "Ask its owner."}
        _, [problem] = sweep_jobs(sweep_of().model_copy(update={"scenes": (SceneSource(**scene),)}), tmp_path)
        assert problem.endswith(" Ask its owner.")


def test_ablations_and_seeds_are_runs_of_their_own(tmp_path: Path) -> None:
    methods = {"zipnerf": {}, "no-decay": {"reconstruct": {"overrides": {"weight_decay": 0.0}}}}
    config = sweep_of("procedural:llff/2?views=6&width=24&height=20", methods=methods, seeds=[0, 1])
    scenes, problems = sweep_jobs(config, tmp_path)
    assert not problems
    assert [j.run for j in scenes[0]] == ["v3-zipnerf", "v3-zipnerf-s1", "v3-no-decay", "v3-no-decay-s1"]
    assert scenes[0][2].config.reconstruct.overrides == TRAINER | {"weight_decay": 0.0}


@pytest.mark.parametrize(
    "path", sorted((Path(__file__).parents[3] / "flows" / "sweeps").glob("*.yaml")), ids=lambda p: p.stem
)
def test_shipped_sweeps_are_valid(path: Path) -> None:
    config = parse_config(yaml.safe_load(path.read_text()), path.name, SweepConfig)
    for label, settings in config.methods.items():
        parse_config(merged(config.base, settings, {"label": label}), path.name)


def test_settings_of_the_command_line_are_those_of_all_runs(tmp_path: Path) -> None:
    (tmp_path / "cluster.yaml").write_text("execution: {executor: dask, dask_address: tcp://10.0.0.1:8786}")
    given = load_config(tmp_path / "cluster.yaml").model_dump(mode="json", exclude_unset=True)
    changed = with_settings(sweep_of("procedural:llff/2?views=6&width=24&height=20"), given)
    [[job]] = sweep_jobs(changed, tmp_path)[0]
    assert (job.config.execution.executor, job.config.execution.dask_address) == ("dask", "tcp://10.0.0.1:8786")
    assert job.config.reconstruct.overrides == TRAINER
    assert sweep_of(workers=3).base["execution"] == {"workers": 3}, "short for it"


def test_results_name_regressions_that_seeds_do_not_explain(tmp_path: Path) -> None:
    row = {"scene_id": "a", "run": "v3-zipnerf", "key": "k", "protocol": "google", "view": 0, "width": 8, "height": 8,
           "ssim": 0.5, "lpips": 0.3, "lpips_backbone": "lpips-vgg", "method": "zipnerf", "split": "3"}  # fmt: skip
    for name, changes in {"old": {}, "worse": {"shift": -1.0}, "noise": {"shift": -0.05}, "better": {"shift": 1.0},
                          "other": {"lpips": 0.9, "lpips_backbone": "st-lpips-alex"}}.items():  # fmt: skip
        shift = float(changes.pop("shift", 0.0))  # type: ignore[arg-type]
        seeds = [{"run": f"v3-zipnerf-s{s}", "seed": s, "psnr_db": 20.0 + 0.1 * s + shift} for s in range(5)]
        append_rows(tmp_path / name / "metrics", metric_table(), [row | changes | seed for seed in seeds], "a")
    counts = {name: compare(tmp_path / name, tmp_path / "old") for name in ("old", "worse", "noise", "better", "other")}
    assert counts == {"old": 0, "worse": 1, "noise": 0, "better": 0, "other": 0}


def test_results_command_exits_1_on_a_regression_only(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    row = {"scene_id": "a", "key": "k", "protocol": "google", "view": 0, "width": 8, "height": 8, "split": "3",
           "ssim": 0.5, "method": "zipnerf"}  # fmt: skip
    for name, values in {"old": [20.0, 20.1], "worse": [15.0, 15.1], "one": [15.0]}.items():
        rows = [row | {"psnr_db": value, "seed": s, "run": f"v3-s{s}"} for s, value in enumerate(values)]
        append_rows(tmp_path / name / "metrics", metric_table(), rows, "a")
    old, worse, one = (str(tmp_path / name) for name in ("old", "worse", "one"))
    for arguments, code in {(old,): 0, (worse, "--against", old): 1, (old, "--against", worse): 0,
                            (one, "--against", old): 0}.items():  # fmt: skip
        assert CliRunner().invoke(app, ["results", *arguments]).exit_code == code
    assert compare(tmp_path / "one", tmp_path / "old") == 0
    assert "one seed cannot tell whether that is noise" in " ".join(capfd.readouterr().out.split())


def test_open_jobs_is_empty_only_when_everything_is_stored(tmp_path: Path, prefect_url: str) -> None:
    config = sweep_of("procedural:llff/2?views=6&width=24&height=20")
    assert run_sweep(config, tmp_path) == []
    scenes, _ = sweep_jobs(config, tmp_path)
    assert open_jobs(scenes[0]) == []
    shutil.rmtree(tmp_path / "procedural_llff_2.zarr")
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


@pytest.mark.slow
def test_a_sweep_killed_at_any_moment_ends_with_the_results_of_an_undisturbed_one(tmp_path: Path, prefect_url: str):
    """Two scenes with and without generated views; SIGKILL after 6 to 12 s, then the same command again."""
    model = random_model(tmp_path / "tiny.safetensors")
    generated = {"method": "cat3d", "plan": {"views": 8}, "sample": {"checkpoint": str(model), "steps": 2},
                 "skip": {"covered_path": False}}  # fmt: skip
    longer = {"reconstruct": {"overrides": TRAINER | {"iterations": 60}}}
    scenes = [{"source": f"procedural:{family}/2?views=9&width=24&height=20"} for family in ("llff", "dtu")]
    sweep = {"name": "killed", "scenes": scenes, "splits": ["3", "6"], "base": merged(BASE, longer),
             "methods": {"zipnerf": {"method": "zipnerf"}, "cat3d": generated}}  # fmt: skip
    (tmp_path / "sweep.yaml").write_text(yaml.safe_dump(sweep))
    arguments = {name: command("sweep", str(tmp_path / "sweep.yaml"), "--out", str(tmp_path / name)) for name in "ab"}
    subprocess.run(arguments["a"], cwd=ROOT, env=environment(), check=True, capture_output=True)
    kills = 0
    for seconds in (6, 12, 9, 10, 7, 11):
        process = subprocess.Popen(arguments["b"], cwd=ROOT, env=environment(), stdout=subprocess.DEVNULL)
        try:
            process.wait(seconds)
            break
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
            kills += 1
    subprocess.run(arguments["b"], cwd=ROOT, env=environment(), check=True, capture_output=True)
    assert kills >= 1
    a, b = (read_rows(tmp_path / name / "metrics", metric_table()).to_pylist() for name in "ab")
    assert len(a) == 2 * 2 * 2 * 2, "scenes, splits, methods, held-out views"
    assert a == b
