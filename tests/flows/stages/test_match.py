"""Stage match and what follows from it: hints are stored, put together with samples, and trusted as far as they go."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from cat3d_core.matching.checkpoint import save_sweep
from cat3d_core.matching.composite import Composite
from cat3d_core.matching.config import SweepConfig
from cat3d_core.matching.network import SweepNetwork
from flows.errors import InputError
from flows.generation.groups import StoredPlan
from flows.generation.hints import SAMPLE_CONFIDENCE, explained_views, open_sweep, read_hint
from flows.generation.open import open_generator
from flows.generation.views import decoded, generated_views
from flows.jobs.job import Job
from flows.jobs.request import Request, make_config
from flows.media.images import to_uint8
from flows.pipeline.keys import expected_steps, stages_of
from flows.stages import match as match_stage
from flows.stages.sample import group_cost, group_sampler
from flows.stages.training_views import training_views
from schemas.scene_store import SceneStore
from schemas.verify import verify
from tests.flows.workers.scene import random_model, run_of, run_stages

SOURCE, VIEWS = "procedural:dtu/3?views=9&width=32&height=24", 10
TINY = SweepConfig(
    encoder=(8, 8, 16, 16), coarse_features=8, fine_features=8, photo_planes=8, target_planes=8, hypotheses=3,
    volume=(8, 8, 16), finish=(8, 8, 16, 16),
)  # fmt: skip
UP_TO_DECODE = ("ingest", "poses", "plan", "match", "encode", "sample", "decode")


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return random_model(tmp_path_factory.mktemp("model") / "tiny.safetensors")


def sweep_file(path: Path, composite: Composite | None = None) -> Path:
    torch.manual_seed(1)
    save_sweep(path, SweepNetwork(TINY), {"data": "none: random weights for tests"}, composite)
    return path


def job(out: Path, model: Path, *settings: str, split: str = "3") -> Job:
    texts = ["method=cat3d", f"sample.checkpoint={model}", "sample.steps=2", f"plan.views={VIEWS}",
             "skip.covered_path=false", "skip.coverage=false", *settings]  # fmt: skip
    return Request(SOURCE, out, (split,), make_config({}, None, texts)).jobs()[0]


def test_hints_are_for_the_shipped_model_and_where_they_are_asked_for(tmp_path: Path, model: Path) -> None:
    assert "match" not in [s.name for s in stages_of(job(tmp_path, model))]
    assert "match" not in [s.name for s in stages_of(job(tmp_path, model, "method=zipnerf", "hints.use=always"))]
    assert "match" in [s.name for s in stages_of(job(tmp_path, model, "hints.use=always"))]
    shipped = Request(SOURCE, tmp_path, ("3",), make_config({}, None, ["method=cat3d"])).jobs()[0]
    assert "match" in [s.name for s in stages_of(shipped)]
    never = Request(SOURCE, tmp_path, ("3",), make_config({}, None, ["method=cat3d", "hints.use=never"])).jobs()[0]
    assert "match" not in [s.name for s in stages_of(never)]


def test_a_file_that_is_no_plane_sweep_is_refused_before_anything_runs(tmp_path: Path, model: Path) -> None:
    with pytest.raises(InputError, match=r"hints.checkpoint: .*tiny.safetensors is no plane sweep"):
        expected_steps(job(tmp_path, model, "hints.use=always", f"hints.checkpoint={model}"))
    with pytest.raises(InputError, match=r"hints.checkpoint: there is no file .*nothing"):
        expected_steps(job(tmp_path, model, "hints.use=always", f"hints.checkpoint={tmp_path / 'nothing'}"))


def test_views_are_photos_where_they_show_the_place_and_samples_elsewhere(tmp_path: Path, model: Path) -> None:
    sweep = sweep_file(tmp_path / "sweep.safetensors", Composite(0.5, 0.1))
    one = job(tmp_path / "out", model, "hints.use=always", f"hints.checkpoint={sweep}", "skip.explained=false")
    records = run_stages(one, *UP_TO_DECODE)
    assert records["match"].work["views"] == VIEWS
    run = run_of(one)
    assert not explained_views(one, run).any()
    generator, network = open_generator(one), open_sweep(one)
    for view in (0, VIEWS - 1):
        hint, sample = read_hint(run, view), decoded(generator, run.generated, view)
        share = network.composite.share(hint.confidence)[..., None]
        expected = (1 - share) * sample + share * hint.colour.float() / 255
        difference = run.generated.read("image", [view])[0].astype(int) - to_uint8(expected).astype(int)
        assert abs(difference).max() <= 1
        trust = (1 - share[..., 0]) * SAMPLE_CONFIDENCE + share[..., 0] * hint.confidence
        assert torch.from_numpy(run.generated.read("confidence", [view])[0]).float() == pytest.approx(trust, abs=1e-3)
    made = list(generated_views(run))
    assert len(made) == VIEWS
    views, decisions = training_views(one, SceneStore.open(one.store_path), run)
    assert views.weight is not None
    assert views.inverse_depth is not None
    assert views.inverse_depth_weight is not None
    assert float(views.map(views.inverse_depth_weight, 3).max()) == 0, "no depth of a generated view is used"
    assert any("Depths of the captured views go with them" in d.text for d in decisions)
    assert bool((views.map(views.weight, 0) == 1).all())  # a captured view is trusted wholly
    assert float(views.map(views.weight, 3).max()) < 1


def test_a_view_that_photos_show_wholly_is_not_sampled(tmp_path: Path, model: Path) -> None:
    sweep = sweep_file(tmp_path / "sweep.safetensors", Composite(-1.0, 0.01))  # everything is the photos' own
    one = job(tmp_path / "out", model, "hints.use=always", f"hints.checkpoint={sweep}")
    records = run_stages(one, *UP_TO_DECODE)
    run = run_of(one)
    assert explained_views(one, run).all()
    assert records["sample"].work["evaluations"] == 0
    saved = [d for d in records["sample"].decisions if d.switch == "explained"]
    plan = StoredPlan(SceneStore.open(one.store_path), run, 0)
    assert saved
    assert saved[0].saved["evaluations"] == sum(
        group_cost(one, group, group_sampler(one, plan, group)).evaluations for group in plan.groups
    )
    assert not run.generated.read("done_latent").any()
    assert np.array_equal(run.generated.read("image"), run.section("hints").read("colour"))


def test_a_model_that_takes_hints_is_given_them(tmp_path: Path) -> None:
    sweep = sweep_file(tmp_path / "sweep.safetensors")
    model = random_model(tmp_path / "hinted.safetensors", hints=True)
    one = job(tmp_path / "out", model, "hints.use=always", f"hints.checkpoint={sweep}", "sample.start=hint")
    run_stages(one, *UP_TO_DECODE)
    store, run = SceneStore.open(one.store_path), run_of(one)
    plan = StoredPlan(store, run, 0)
    group = plan.view_group(plan.groups[0], open_generator(one))
    targets = plan.groups[0].targets
    assert group.hints["colour"].shape == (len(targets), 3, 64, 64)
    for i, view in enumerate(targets):
        hint = read_hint(run, view)
        assert torch.equal(group.hints["colour"][i], hint.colour.permute(2, 0, 1) / 255)
        assert torch.equal(group.hints["confidence"][i], hint.confidence)
    without = job(tmp_path / "out", model, "hints.use=never")
    assert not StoredPlan(store, run, 0, hinted=without.hinted).view_group(plan.groups[0], open_generator(one)).hints


def test_anchors_of_a_single_photo_are_always_sampled(tmp_path: Path, model: Path) -> None:
    sweep = sweep_file(tmp_path / "sweep.safetensors", Composite(-1.0, 0.01))
    one = job(tmp_path / "out", model, "hints.use=always", f"hints.checkpoint={sweep}", split="1")
    run_stages(one, *UP_TO_DECODE)
    run = run_of(one)
    anchors = run.plan.read("anchor")
    assert anchors.any()
    assert not explained_views(one, run)[anchors].any()
    assert run.generated.read("done_latent").any(-1)[anchors].all()
    views, decisions = training_views(one, SceneStore.open(one.store_path), run)
    assert views.inverse_depth_weight is None or not views.inverse_depth_weight.any(), "nothing confirms its depth"
    assert not any("Depths of the captured views" in d.text for d in decisions)


def test_an_interrupted_match_makes_what_is_missing(tmp_path: Path, model: Path, monkeypatch) -> None:
    sweep = sweep_file(tmp_path / "sweep.safetensors")
    one = job(tmp_path / "out", model, "hints.use=always", f"hints.checkpoint={sweep}")
    run_stages(one, "ingest", "poses", "plan")
    store = match_stage._store
    monkeypatch.setattr(match_stage, "AT_ONCE", 4)

    def once(*arguments: object) -> None:
        store(*arguments)  # type: ignore[arg-type]
        raise KeyboardInterrupt

    monkeypatch.setattr(match_stage, "_store", once)
    with pytest.raises(KeyboardInterrupt):
        run_stages(one, "match")
    before = run_of(one).section("hints").read("colour", [0])
    monkeypatch.setattr(match_stage, "_store", store)
    assert run_stages(one, "match")["match"].work["views"] == VIEWS - 4
    assert np.array_equal(run_of(one).section("hints").read("colour", [0]), before)


@pytest.mark.parametrize("covered", [False, True])
def test_what_is_not_looked_for_is_no_damage(
    tmp_path: Path, model: Path, covered: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`cat3d inspect --verify` of a run whose path the photos cover, so that nothing is matched or generated."""
    sweep = sweep_file(tmp_path / "sweep.safetensors", Composite(0.0, 0.1))
    if covered:
        monkeypatch.setattr("flows.stages.plan.COVERED_SHARE", 0.0)
    settings = ("hints.use=always", f"hints.checkpoint={sweep}", f"skip.covered_path={str(covered).lower()}")
    one = job(tmp_path / "out", model, *settings)
    records = run_stages(one, *UP_TO_DECODE)
    assert records["match"].work["views"] == (0 if covered else VIEWS)
    assert list(verify(SceneStore.open(one.store_path))) == []
