"""Generated views end to end: `cat3d plan`, `cat3d run --method cat3d` from three photos and from one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from cat3d_core.cameras import Cameras
from cat3d_core.rays import raymap
from cat3d_core.sample_sets import source_boxes
from flows.errors import InputError
from flows.generation.groups import StoredPlan
from flows.generation.open import open_generator
from flows.generation.views import GeneratedView, generated_views
from flows.jobs.job import Job
from flows.jobs.request import Request, make_config, make_request
from flows.media.images import PADDING, read_image, square_image
from flows.pipeline.keys import pending
from flows.stages.training_views import no_finer
from schemas.errors import ConfigError
from schemas.scene_store import SceneStore
from schemas.tables import TIMINGS, read_rows
from tests.flows.conftest import TINY
from tests.flows.workers.scene import make_job, prepare, random_model, run_of, run_stages

SCENE = "procedural:dtu/3?views=9&width=32&height=24"


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return random_model(tmp_path_factory.mktemp("model") / "tiny.safetensors")


def options(model: Path, count: int = 8) -> list[str]:
    chosen = [f"sample.checkpoint={model}", "sample.steps=3", f"plan.views={count}"]
    return [part for text in chosen for part in ("--set", text)]


def test_photos_in_generated_views_field_and_renders_out(model: Path, tmp_path: Path, cat3d) -> None:
    arguments = ["--method", "cat3d", "--out", str(tmp_path), *TINY, *options(model), "--views", "3,1"]
    cat3d("run", SCENE, *arguments)
    store = SceneStore.open(tmp_path / "procedural_dtu_3.zarr")
    assert store.latents.read("captured", [0]).shape == (1, 8, 8, 8)
    rows = read_rows(tmp_path / "timings", TIMINGS).to_pylist()
    assert [r["stage"] for r in rows].count("encode") == 1, "captured views are encoded once for the scene"
    for name in ("v3-cat3d", "v1-cat3d"):
        run = store.run(name)
        assert run.generated.read("image").shape == (8, 64, 64, 3)
        assert store.record("reconstruct", name).work["views"] == 8 + int(name[1])
        assert store.record("evaluate", name) is not None
        assert (tmp_path / "procedural_dtu_3" / name / "plan.png").exists()

    def stale(checkpoint: Path) -> list:
        given = [*TINY, *options(checkpoint)]
        texts = [value for flag, value in zip(given[::2], given[1::2]) if flag == "--set"]
        config = make_config({"method": "cat3d", "downscale": 1.0, "preset": "fast", "seed": 0}, None, texts)
        return [pending(job) for job in Request(SCENE, tmp_path, ("3", "1"), config).jobs()]

    assert stale(model) == [[], []]
    moved = model.rename(model.with_name("elsewhere.safetensors"))
    try:
        assert stale(moved) == [[], []], "the weights count, not where they are"
    finally:
        moved.rename(model)


def test_the_plan_is_printed_drawn_and_stored_before_anything_is_sampled(model: Path, tmp_path: Path, capfd) -> None:
    from flows.commands.plan import plan_command

    settings = [f"sample.checkpoint={model}", "skip=none"]
    given = {"trajectory": "single_orbit", "count": 20}
    (job,) = plan_command(make_request(SCENE, tmp_path, "1", given | {"method": "cat3d"}, settings=settings))
    printed = " ".join(capfd.readouterr().out.split())
    assert "single_orbit: 20 views in" in printed
    assert "anchors" in printed
    assert "The trajectory single_orbit was asked for." in printed
    run = run_of(job)
    assert run.plan.attrs["recipe"] == "single_orbit"
    assert run.plan.read("world_from_camera").shape == (20, 4, 4)
    assert run.generated.names() == []
    picture, _ = read_image(job.pictures / "plan.png")
    assert picture.shape[1] > 800
    assert [s.stage for s in pending(job)][0] == "encode", "a run goes on from here"


def test_settings_that_cannot_be_planned_end_in_a_sentence(model: Path, tmp_path: Path) -> None:
    def job(*settings: str) -> Job:
        texts = ["method=cat3d", f"sample.checkpoint={model}", *settings]
        return Request(SCENE, tmp_path, ("3",), make_config({}, None, texts)).jobs()[0]

    with pytest.raises(ConfigError, match="no trajectory 'circle'"):
        prepare(job("plan.trajectory=circle"))
    with pytest.raises(ConfigError, match="come to 9 views, but the model takes 8"):
        prepare(job("plan.group_size=6"))
    with pytest.raises(InputError, match="there is no model file /nowhere.safetensors"):
        prepare(job("sample.checkpoint=/nowhere.safetensors"))


def test_wide_samples_are_planned_encoded_and_kept_without_their_padding(model: Path, tmp_path: Path) -> None:
    texts = ["method=cat3d", f"sample.checkpoint={model}", "plan.views=5", "plan.wide=true", "sample.steps=3"]
    texts.append("execution.workers=1")
    job = Request(SCENE, tmp_path, ("3",), make_config({}, None, texts)).jobs()[0]
    prepare(job)
    store = SceneStore.open(job.store_path)
    plan = StoredPlan(store, store.run(job.run), 0)
    assert [g.kind for g in plan.groups] == ["square", "wide"]
    square, wide = (plan.condition_latents(g) for g in plan.groups)
    assert square.shape == wide.shape == (3, 8, 8, 8)
    assert not torch.equal(square, wide)
    run_stages(job, "sample", "decode")
    views = list(generated_views(run_of(job)))
    assert [tuple(view.image.shape) for view in views] == [(64, 64, 3)] * 5 + [(48, 64, 3)] * 5
    for narrow, broad in zip((v.camera for v in views[:5]), (v.camera for v in views[5:])):
        assert torch.equal(narrow.world_from_camera, broad.world_from_camera)
        # The same sky: 24 rows of the photo are 64 rows of the square sample and 48 of the wide one.
        assert torch.allclose(narrow.intrinsics[0, 1, 1] / 64, broad.intrinsics[0, 1, 1] / 48)
        assert torch.allclose(broad.intrinsics[0, :2, 2], torch.tensor([32.0, 24.0], dtype=torch.float64), atol=0.5)


def test_squares_are_cut_from_the_middle_or_padded_with_grey() -> None:
    image = np.zeros((24, 32, 3), np.uint8)
    image[:, 4:28] = 255
    size = torch.tensor([[32, 24]])
    assert (square_image(image, source_boxes(size, "square")[0].tolist(), 24) == 255).all()
    wide = square_image(image, source_boxes(size, "wide")[0].tolist(), 32)
    assert (wide[:4] == PADDING).all()
    assert (wide[28:] == PADDING).all()
    assert np.array_equal(wide[4:28], image)


def test_raymaps_and_conditions_follow_the_world_frame_of_the_store(model: Path, tmp_path: Path) -> None:
    """A conditioning view's raymap is that of the captured camera cut to its square; the first one is at the origin."""
    job = make_job(tmp_path, model)
    prepare(job)
    store = SceneStore.open(job.store_path)
    plan = StoredPlan(store, store.run(job.run), 0)
    group = plan.groups[1]
    cameras = plan.view_group(group, open_generator(job)).cameras
    maps = raymap(cameras, cameras.world_from_camera[0], 8, 8).float()
    assert maps.shape == (8, 6, 8, 8)
    assert torch.allclose(maps[0, :3], torch.zeros(3, 8, 8), atol=1e-6)
    centre = maps[0, 3:, 3:5, 3:5].mean((1, 2))
    assert torch.allclose(centre / centre.norm(), torch.tensor([0.0, 0.0, 1.0]), atol=1e-2)
    first, second = (plan.captured["square"][c] for c in group.conditions[:2])
    moved = first.camera_from_world[0] @ second.world_from_camera[0]
    assert torch.allclose(maps[1, :3, 0, 0], moved[:3, 3].float(), atol=1e-5)


def test_generated_views_finer_than_the_photos_are_reduced_to_their_focal_length() -> None:
    intrinsics = torch.tensor([[[100.0, 0, 32], [0, 100, 24], [0, 0, 1]]])
    camera = Cameras(intrinsics, torch.eye(4)[None], torch.tensor([[64, 48]]))
    image = torch.full((48, 64, 3), 90, dtype=torch.uint8)
    trust = torch.linspace(0, 1, 48 * 64).reshape(48, 64)
    whole = GeneratedView(camera, image, trust)
    assert no_finer(whole, 100.0) is whole
    reduced, smaller, trusted = no_finer(whole, 50.0)
    assert trusted is not None
    assert trusted.shape == (24, 32)
    assert reduced.size.tolist() == [[32, 24]]
    torch.testing.assert_close(reduced.intrinsics[0, :2], intrinsics[0, :2] / 2)
    assert torch.equal(smaller, torch.full((24, 32, 3), 90, dtype=torch.uint8))
