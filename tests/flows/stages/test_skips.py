"""Skips: each switch touches its own stage, off it changes nothing, on it leaves a whole store and says what it did."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from cat3d_core.cameras import Cameras
from cat3d_core.diffusion import GuidanceConfig, SamplerConfig, sample
from cat3d_core.generation import Cat3dGenerator
from cat3d_core.plan import PlanConfig, make_plan
from cat3d_core.rays import reference_from_image
from cat3d_core.reconstruction import Views
from cat3d_core.zipnerf import Trainer, ZipNerfConfig
from cat3d_core.zipnerf.settings import config_from_document, fitted, left_out
from flows.generation.groups import StoredPlan
from flows.generation.open import open_generator
from flows.generation.plan import read_plan
from flows.generation.views import generated_views
from flows.jobs.access import read_cameras, read_images
from flows.jobs.job import Job
from flows.jobs.request import Request, make_config
from flows.media.images import to_uint8
from flows.pipeline.keys import expected_steps
from flows.reconstruction.open import open_reconstructor
from flows.reconstruction.stored import read_reconstruction
from flows.reporting.inspect import inspect_store
from flows.stages import sample as sample_stage
from flows.stages.sample import group_sampler
from flows.stages.training_views import training_views
from schemas.config import parse_config
from schemas.errors import ConfigError
from schemas.scene_store import SceneStore
from schemas.skip import SkipConfig
from schemas.stages import StageRecord
from tests.flows.workers.scene import random_model, run_of, run_stages

SOURCE = "procedural:dtu/3?views=9&width=32&height=24"
SMALL = (
    "reconstruct.overrides={iterations: 6, batch_rays: 64, samples: [8, 8], grid_max: [32, 64], grid_features: [1, 2], \
interlevel_blur: [0.03], grid_log2_table: 10, warmup_iterations: 2, lpips_weight: 0.0}"
)
#: Generated views: three groups.
VIEWS = 12
UP_TO_FIELD = ("ingest", "poses", "plan", "encode", "sample", "decode", "reconstruct")


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return random_model(tmp_path_factory.mktemp("model") / "tiny.safetensors")


def job(out: Path, model: Path, *settings: str, split: str = "3") -> Job:
    texts = ["method=cat3d", f"sample.checkpoint={model}", "sample.steps=4", f"plan.views={VIEWS}", SMALL, *settings]
    return Request(SOURCE, out, (split,), make_config({}, None, texts)).jobs()[0]


def trainer_config(job: Job) -> ZipNerfConfig:
    return config_from_document(open_reconstructor(job).settings["trainer"])


def field_of(job: Job) -> dict[str, np.ndarray]:
    field = run_of(job).field
    return {name: field.read(name) for name in field.attrs["parameters"]}


def texts(record: StageRecord) -> list[str]:
    return [decision.text for decision in record.decisions]


def problems(job: Job) -> list:
    return inspect_store(job.store_path, verify_chunks=True)["problems"]


def test_all_none_and_single_switches() -> None:
    def skip(value: object) -> SkipConfig:
        return parse_config({"skip": value}, "test").skip

    assert not any(skip("none").model_dump().values())
    assert all(skip("all").model_dump().values())
    assert skip({}) == SkipConfig()
    assert skip({"rounds": True}) == SkipConfig(rounds=True)
    with pytest.raises(ConfigError, match="skip.everything is not a setting"):
        skip({"everything": True})


def test_a_switch_makes_its_own_stage_stale_and_none_before_it(model: Path, tmp_path: Path) -> None:
    first = {"coverage": "plan", "covered_path": "plan", "rounds": "sample", "near_steps": "sample", "solver": "sample",
             "explained": None,  # there are no hints with this model
             "guidance": "sample", "workers": None, "detail": "reconstruct", "seen": "reconstruct",
             "empty_space": "reconstruct", "proposals": "reconstruct", "plateau": "reconstruct",
             "rays": "reconstruct", "lpips": "reconstruct",
             "low_resolution": "reconstruct"}  # fmt: skip
    scene = job(tmp_path, model).scene

    def keys(**changed: bool) -> dict[str, str]:
        settings = [
            f"skip.{name}={str(value).lower()}"
            for name, value in (dict.fromkeys(SkipConfig.model_fields, False) | changed).items()
        ]  # noqa: E501
        one = job(tmp_path, model, "sample.guidance=3", "reconstruct.overrides={}", *settings)
        return {stage: step.key for stage, step in expected_steps(one.sharing(scene)).items()}

    none = keys()
    for name in SkipConfig.model_fields:
        changed = [stage for stage, key in keys(**{name: True}).items() if key != none[stage]]
        assert changed[:1] == ([first[name]] if first[name] else []), name


def test_without_skips_every_stage_is_the_plain_core_bit_for_bit(model: Path, tmp_path: Path) -> None:
    one = job(tmp_path, model, "skip=none", "sample.guidance=3", "execution.workers=1")
    run_stages(one, *UP_TO_FIELD)
    store = SceneStore.open(one.store_path)
    run = store.run(one.run)
    train = np.flatnonzero(run.read("role") == 1).tolist()
    captured = read_cameras(store.captured, train)
    plain = make_plan(captured, PlanConfig(count=VIEWS, conditions=3, image_size=64), _points(store), _bounds(store))
    assert np.array_equal(run.plan.read("world_from_camera"), plain.cameras.world_from_camera.numpy())
    assert read_plan(run.plan, 9).groups == plain.among(train, 9).groups
    plan, generator = StoredPlan(store, run, one.config.seed), open_generator(one)
    assert isinstance(generator, Cat3dGenerator)
    network = generator.model
    config = SamplerConfig("ddim", "trailing", 4, GuidanceConfig(3.0), micro_batch=1)
    threads = torch.get_num_threads()
    torch.set_num_threads(one.config.execution.threads)
    try:
        for group in plan.groups[:2]:
            given = plan.view_group(group, generator)
            cameras = reference_from_image(given.cameras, given.cameras.world_from_camera[0])[None]
            latents = sample(network, given.latents[None], cameras, given.noise[None], config)[0].half()
            assert np.array_equal(run.generated.read("latent", group.targets), latents.numpy())
            with torch.no_grad():
                decoded = network.autoencoder.decode(latents[:1].float()).permute(0, 2, 3, 1)
            assert np.array_equal(run.generated.read("image", group.targets[:1]), to_uint8(decoded))
    finally:
        torch.set_num_threads(threads)
    made = list(generated_views(run))
    assert len(made) == VIEWS
    cameras = Cameras.cat([captured, *(view.camera for view in made)])
    images = [*read_images(store.captured, train), *(view.image for view in made)]
    views = Views.from_images(cameras, images, torch.arange(len(cameras)) < 3)
    trainer = Trainer(trainer_config(one), views, one.config.seed)
    while not trainer.finished:
        trainer.step()
    for name, value in trainer.field.state_dict().items():
        assert torch.equal(value, read_reconstruction(store, run).tensors()[name]), name


def _points(store: SceneStore) -> torch.Tensor | None:
    return torch.from_numpy(store.captured.read("points")) if "points" in store.captured else None


def _bounds(store: SceneStore) -> torch.Tensor | None:
    return torch.from_numpy(store.captured.read("depth_bounds")) if "depth_bounds" in store.captured else None


def test_short_work_is_done_without_workers_and_is_the_same(model: Path, tmp_path: Path) -> None:
    results = {}
    for name in ("true", "false"):
        one = job(tmp_path / name, model, "skip=none", f"seed={1}")
        settings = one.config.skip.model_copy(update={"workers": name == "true"})
        one = one.model_copy(update={"config": one.config.model_copy(update={"skip": settings})})
        records = run_stages(one, *UP_TO_FIELD[:-1])
        told = " ".join(texts(records["sample"]))
        assert ("Started no workers" in told) == (name == "true")
        assert records["sample"].work["evaluations"] == 2 * 4 * records["sample"].work["groups"]
        generated = run_of(one).generated
        results[name] = generated.read("latent"), generated.read("image")
    for here, there in zip(results["true"], results["false"], strict=True):
        assert np.array_equal(here, there)


def test_a_covered_path_is_not_sampled_decoded_or_missed(model: Path, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("flows.stages.plan.COVERED_SHARE", 0.0)
    one = job(tmp_path, model)
    records = run_stages(one, *UP_TO_FIELD)
    assert any("need not be generated" in d.text for d in records["plan"].decisions)
    assert any(f"{VIEWS} of {VIEWS} planned views were left out" in d.text for d in records["sample"].decisions)
    assert any(f"Skipped decoding {VIEWS} of {VIEWS}" in d.text for d in records["decode"].decisions)
    assert any("captured views alone" in d.text for d in records["reconstruct"].decisions)
    assert records["sample"].work["evaluations"] == 0
    assert records["reconstruct"].work["views"] == 3
    assert not problems(one), "views left out on purpose are no damage"


def test_views_that_an_earlier_run_sampled_are_left_out_when_they_are_no_longer_wanted(
    model: Path, tmp_path: Path, monkeypatch
) -> None:
    one = job(tmp_path, model, "skip.coverage=false")
    run_stages(one, *UP_TO_FIELD[:-1])
    assert len(list(generated_views(run_of(one)))) == VIEWS
    monkeypatch.setattr("flows.stages.plan.COVERED_SHARE", 0.0)
    run_stages(one, *UP_TO_FIELD[:-1])
    assert list(generated_views(run_of(one))) == []


def test_rounds_stop_when_the_held_out_view_no_longer_improves(model: Path, tmp_path: Path, monkeypatch) -> None:
    settings = "skip={rounds: true, covered_path: false, coverage: false}"
    told = texts(run_stages(job(tmp_path / "cheap", model, settings), *UP_TO_FIELD[:-1])["sample"])
    assert any(d.startswith("Sampled in one round: all groups cost less than") for d in told)
    monkeypatch.setattr("flows.generation.rounds.BRIEF_FLOPS", 0.0)
    one = job(tmp_path, model, settings)
    records = run_stages(one, *UP_TO_FIELD)
    told = [d for d in texts(records["sample"]) if "ound" in d]
    assert told[0].startswith("Round 1: with 1 more groups the held-out captured view went from ")
    assert "chosen for this scene in" in told[-1]
    used = len(list(generated_views(run_of(one))))
    assert records["reconstruct"].work["views"] == 3 + used
    assert records["decode"].work["views"] == used < VIEWS, "a random model helps nothing, so its views are not used"
    assert not problems(one)
    again = job(tmp_path / "again", model, settings)
    assert [d for d in texts(run_stages(again, *UP_TO_FIELD)["sample"]) if "ound" in d] == told
    for name, values in field_of(one).items():
        assert np.array_equal(values, field_of(again)[name]), name


def test_one_photo_is_sampled_in_one_round(model: Path, tmp_path: Path) -> None:
    one = job(tmp_path, model, "skip={rounds: true}", split="1")
    told = texts(run_stages(one, *UP_TO_FIELD[:-1])["sample"])
    assert "Sampled in one round: a single captured view cannot be held out." in told


def test_groups_near_captured_views_take_half_of_the_steps(model: Path, tmp_path: Path, monkeypatch) -> None:
    one = job(tmp_path, model, "skip={near_steps: true, covered_path: false}")
    run_stages(one, *UP_TO_FIELD[:4])
    store = SceneStore.open(one.store_path)
    plan = StoredPlan(store, store.run(one.run), 0)
    distances = [plan.distance(group) for group in plan.groups]
    near = sorted(distances)[1]
    monkeypatch.setattr(sample_stage, "NEAR", near + 1e-9)
    steps = [group_sampler(one, plan, group).steps for group in plan.groups]
    assert steps == [2 if d <= near else 4 for d in distances]
    group = plan.groups[0]
    centers = plan.cameras[group.targets].centers
    known = plan.captured["square"][group.conditions]
    shift = torch.cdist(centers, known.centers)
    turn = torch.cdist(plan.cameras[group.targets].forward, known.forward)
    assert distances[0] == pytest.approx(float((shift**2 + turn**2).sqrt().amin(1).mean()), abs=1e-9)
    record = run_stages(one, "sample")["sample"]
    assert record.work["steps"] == sum(steps)
    assert any("took 2 steps" in d.text for d in record.decisions)


def test_another_path_does_not_render_the_held_out_views_again(model: Path, tmp_path: Path) -> None:
    stages = ("ingest", "poses", "reconstruct", "render")
    rendered = []
    for frames in (2, 3):
        one = job(tmp_path, model, "method=zipnerf", f"render.path_views={frames}")
        rendered.append(run_stages(one, *stages)["render"])
    test = len(run_of(one).renders("test").read("view"))
    assert [record.work["views"] for record in rendered] == [test + 2, 3]
    assert any(f"Skipped {test} of {test + 3} renders" in d.text for d in rendered[1].decisions)


def test_generated_views_are_no_finer_than_the_photos_and_it_is_said(model: Path, tmp_path: Path) -> None:
    one = job(tmp_path, model, "skip=none")
    run_stages(one, *UP_TO_FIELD[:-1])
    store = SceneStore.open(one.store_path)
    whole, told = training_views(one, store, store.run(one.run))
    assert (left_out(whole), told) == (0.0, [])
    assert whole.size[3:].tolist() == [[64, 64]] * VIEWS
    reduced, told = training_views(job(tmp_path, model, "skip={detail: true}"), store, store.run(one.run))
    assert told[0].text.startswith(f"{VIEWS} of {VIEWS} generated views were reduced to ")
    assert len(reduced) == len(whole) == 3 + VIEWS
    assert torch.equal(reduced.size[:3], whole.size[:3])
    assert bool((reduced.size[3:] < 64).all())
    assert len(reduced.pixels) < len(whole.pixels)


def test_what_captured_views_show_is_not_learned_from_generated_ones(
    model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    one = job(tmp_path, model, "skip={seen: true, covered_path: false, coverage: false}")
    records = run_stages(one, *UP_TO_FIELD)
    told = next(d for d in texts(records["reconstruct"]) if "captured views show their places" in d)
    store = SceneStore.open(one.store_path)
    views, _ = training_views(one, store, store.run(one.run))
    share = left_out(views)
    assert 0.05 < share < 0.95
    assert told.startswith(f"{share:.0%} of the pixels")
    counting = views.counting
    assert torch.equal(counting[:3], views.size[:3].prod(-1)), "captured pixels all count"
    assert int(counting[3:].sum()) == pytest.approx((1 - share) * int(views.size[3:].prod(-1).sum()), abs=1)
    most = views.only(views.captured.repeat_interleave(views.size.prod(-1)) | (torch.rand(len(views.pixels)) < 0.1))
    assert left_out(most) > 0.85
    assert fitted(trainer_config(one), most, {})[0].captured_share == left_out(most)
    monkeypatch.setattr("flows.stages.training_views.ENOUGH", share - 0.01)
    assert len(training_views(one, store, store.run(one.run))[0]) > 3, "three photos are too few for that"
    monkeypatch.setattr("flows.stages.training_views.FEW", 2)
    alone, decisions = training_views(one, store, store.run(one.run))
    assert len(alone) == 3, "captured views show most of what the generated ones do: these are left out"
    assert alone.valid is alone.weight is None, "and the captured ones are trained on as without them"
    assert torch.equal(alone.pixels, views.pixels[: len(alone.pixels)])
    assert decisions[-1].text.startswith("No generated view was trained on")
    monkeypatch.undo()
    single = job(tmp_path / "single", model, "skip={seen: true}", split="1")
    told_of_one = texts(run_stages(single, *UP_TO_FIELD)["reconstruct"])
    assert not any("captured views show" in d for d in told_of_one), "one view alone has no depth"
    assert not problems(one)


def test_training_fits_what_there_is_to_train_on(model: Path, tmp_path: Path) -> None:
    def views(captured: int, generated: int) -> Views:
        count, side = captured + generated, 32
        poses = torch.eye(4, dtype=torch.float64).expand(count, 4, 4)
        cameras = Cameras(torch.eye(3, dtype=torch.float64).expand(count, 3, 3), poses, torch.full((count, 2), side))
        return Views.from_images(
            cameras, [torch.zeros(side, side, 3, dtype=torch.uint8)] * count, torch.arange(count) < captured
        )

    def chosen(given: Views, *settings: str) -> ZipNerfConfig:
        one = job(tmp_path, model, "reconstruct.overrides={}", *settings)
        return fitted(trainer_config(one), given, one.config.skip.model_dump(), one.config.reconstruct.overrides)[0]

    few, both, dense = views(3, 0), views(3, 80), views(20, 0)
    assert chosen(few).batch_rays == 256, "a 24th of 3,072 pixels is less than the least"
    assert chosen(dense).batch_rays == 20 * 32 * 32 // 24
    assert chosen(both).batch_rays == 768, "three quarters of 1,024"
    assert chosen(both, "reconstruct.overrides={iterations: 150}").batch_rays == 1024, "few passes over all pixels"
    assert chosen(both, "skip=none").batch_rays == chosen(few, "skip=none").batch_rays == 1024
    assert chosen(few, "reconstruct.overrides={batch_rays: 512}").batch_rays == 512, "what is asked for stays"
    assert chosen(few).lpips_weight == 0 < chosen(both).lpips_weight
    assert [chosen(v).plateau_tolerance for v in (few, both, dense)] == [0.1, 0.1, 0.01]
    assert [chosen(v).plateau_from for v in (few, both, dense)] == [0.0, 0.4, 0.0]
    assert [chosen(v, "skip.plateau=false").plateau_patience for v in (few, both, dense)] == [0, 0, 0]
