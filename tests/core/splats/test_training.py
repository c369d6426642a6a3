"""Training of splats: it learns, resumes to the bit, obeys masks and trust, and says what is wrong."""

from __future__ import annotations

import dataclasses
import json

import pytest
import torch
from torch import Tensor

from cat3d_core.cameras import Cameras
from cat3d_core.normalization import normalize_scene
from cat3d_core.rays import image_rays
from cat3d_core.reconstruction import ReconstructionRequest
from cat3d_core.reconstruction.render import Render, normals_from_depth
from cat3d_core.reconstruction.views import Views
from cat3d_core.splats.config import PRESETS, REFINE, SplatConfig
from cat3d_core.splats.from_renders import from_renders
from cat3d_core.splats.gaussians import Gaussians
from cat3d_core.splats.rasterize import render
from cat3d_core.splats.rasterize_cpu import available
from cat3d_core.splats.reconstructor import Splats
from cat3d_core.splats.trainer import SplatTrainer, expand, train
from cat3d_core.splats.viewpoints import between
from cat3d_core.synthetic import random_cameras, random_scene, trace
from cat3d_core.zipnerf.coordinates import contract
from cat3d_core.zipnerf.losses import view_weights

pytestmark = pytest.mark.skipif(not available(), reason="There is no C++ compiler here.")
SHORT = dataclasses.replace(PRESETS["tiny"], iterations=100, start=1500, most=2000)


@pytest.fixture(scope="module")
def scene() -> tuple[Views, Views]:
    """Twelve training and two held-out views of a procedural scene, 32 pixels wide."""
    world = random_scene("co3d", 0)
    cameras = random_cameras(world, 0, 14, 32, 32)
    images = [(v * 255).round().to(torch.uint8).permute(1, 2, 0) for v in trace(world, cameras).image.cpu()]
    cameras = normalize_scene(cameras).cameras(cameras)

    def views(rows: list[int]) -> Views:
        return Views.from_images(cameras[rows], [images[i] for i in rows], torch.ones(len(rows), dtype=torch.bool))

    return views([i for i in range(14) if i not in (4, 10)]), views([4, 10])


def psnr(gaussians: Gaussians, views: Views) -> float:
    errors = [
        (render(gaussians, views.cameras, i).image - views.image(i) / 255).square().mean() for i in range(len(views))
    ]
    return float(-10 * torch.stack(errors).mean().log10())


def test_training_learns_the_scene(scene: tuple[Views, Views]) -> None:
    views, held = scene
    trainer = SplatTrainer(SHORT, views, 0)
    before = psnr(trainer.gaussians, held)
    after = psnr(train(trainer), held)
    assert after > before + 2
    assert after > 18.5
    assert len(trainer.gaussians) == 2000
    assert trainer.skipped == 0


def test_a_stopped_training_goes_on_to_the_same_bits(scene: tuple[Views, Views]) -> None:
    views, _ = scene
    config = dataclasses.replace(SHORT, iterations=24)
    whole = SplatTrainer(config, views, 3)
    first = SplatTrainer(config, views, 3)
    for _ in range(13):
        first.step()
    again = SplatTrainer(config, views, 3)
    again.load_state(first.state())
    for name, value in train(whole).tensors().items():
        assert torch.equal(value, train(again).tensors()[name]), name


def test_another_seed_gives_other_splats(scene: tuple[Views, Views]) -> None:
    views, _ = scene
    config = dataclasses.replace(SHORT, iterations=2)
    a, b = (train(SplatTrainer(config, views, seed)).means for seed in (0, 1))
    assert not torch.equal(a, b)


def test_masked_pixels_teach_nothing(scene: tuple[Views, Views]) -> None:
    """The same splats, to the bit, whatever the masked pixels show."""
    views, _ = scene
    found = []
    for shown in (0, 255):
        images, masks = [], []
        for i in range(len(views)):
            image, mask = views.image(i).clone(), torch.ones((32, 32), dtype=torch.bool)
            mask[:, :10] = False
            image[:, :10] = shown
            images.append(image)
            masks.append(mask)
        covered = Views.from_images(views.cameras, images, views.captured, masks)
        first = SplatTrainer(SHORT, views, 0).gaussians
        found.append(train(SplatTrainer(dataclasses.replace(SHORT, iterations=6), covered, 0, first=first)))
    for name, value in found[0].tensors().items():
        assert torch.equal(value, found[1].tensors()[name]), name


def test_far_generated_views_count_less(scene: tuple[Views, Views]) -> None:
    """With one captured view, the loss of a generated one falls with its distance and with progress."""
    views, _ = scene
    captured = torch.zeros(len(views), dtype=torch.bool)
    captured[0] = True
    some = Views.from_images(views.cameras, [views.image(i) for i in range(len(views))], captured)
    trainer = SplatTrainer(dataclasses.replace(SHORT, background=(0.5, 0.5)), some, 0)

    def loss(view: int) -> float:
        trust = view_weights(some.cameras.centers, some.captured, trainer.config, trainer.progress)
        generator = torch.Generator().manual_seed(0)
        return trainer._losses(view, float(trust[view]), generator)["photometric"].item()

    farthest = int((some.cameras.centers - some.cameras.centers[0]).norm(dim=-1).argmax())
    early = loss(0), loss(farthest)
    trainer.iteration = SHORT.iterations
    assert loss(0) == pytest.approx(early[0])
    assert loss(farthest) < 0.5 * early[1]


def test_a_step_that_is_not_finite_changes_nothing_and_too_many_stop(scene: tuple[Views, Views]) -> None:
    views, _ = scene

    def broken(prediction: Tensor, target: Tensor) -> Tensor:
        return prediction.sum() * torch.nan

    config = dataclasses.replace(SHORT, lpips_every=1, max_skipped_steps=2)
    trainer = SplatTrainer(config, views, 0, perceptual=broken)
    before = trainer.state()
    assert trainer.step()["skipped"] == 1
    assert all(torch.equal(v, before[n]) for n, v in trainer.state().items() if n.startswith("splats"))
    trainer.step()
    with pytest.raises(ValueError, match="3 training steps up to iteration 2 had a non-finite loss"):
        trainer.step()


def test_the_perceptual_loss_sees_patches(scene: tuple[Views, Views]) -> None:
    views, _ = scene
    seen: list[torch.Size] = []

    def perceptual(prediction: Tensor, target: Tensor) -> Tensor:
        seen.append(prediction.shape)
        return (prediction - target).abs().mean((1, 2, 3))

    trainer = SplatTrainer(dataclasses.replace(SHORT, patch_size=24), views, 0, perceptual=perceptual)
    terms = [trainer.step() for _ in range(4)]
    assert seen == [torch.Size([1, 3, 24, 24])] * 2
    assert ["perceptual" in numbers for numbers in terms] == [True, False, True, False]
    # At every k-th step, k times the weight; captured pixels count whole.
    captured = dataclasses.replace(views, captured=torch.ones_like(views.captured))
    for every in (1, 3):
        config = dataclasses.replace(SHORT, patch_size=24, lpips_every=every, lpips_weight=0.2)
        trainer = SplatTrainer(config, captured, 0, perceptual=lambda a, b: torch.full((len(a),), 0.5))
        assert trainer.step()["perceptual"] == pytest.approx(every * 0.2 * 0.5)


def test_a_state_that_does_not_fit_is_refused(scene: tuple[Views, Views]) -> None:
    views, _ = scene
    state = SplatTrainer(SHORT, views, 0).state()
    with pytest.raises(ValueError, match="another degree"):
        SplatTrainer(dataclasses.replace(SHORT, degree=1), views, 0).load_state(state)
    with pytest.raises(ValueError, match=r"splats\.logits"):
        SplatTrainer(SHORT, views, 0).load_state({n: v for n, v in state.items() if n != "splats.logits"})


def test_settings_that_contradict_each_other_are_refused() -> None:
    for change in (
        {"most": 10},
        {"degree": 3},
        {"near": 0.0},
        {"lr_final": 0.0},
        {"dead_opacity": 1.0},
        {"iterations": 0},
    ):
        with pytest.raises(ValueError):
            dataclasses.replace(PRESETS["fast"], **change)  # type: ignore[arg-type]
    assert isinstance(PRESETS["paper"], SplatConfig)


def test_expand_undoes_contract() -> None:
    points = torch.randn((500, 3), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    points = points * torch.logspace(-3, 2.5, 500, dtype=torch.float64)[:, None]
    torch.testing.assert_close(expand(contract(points)), points, rtol=1e-9, atol=0)


def test_splats_of_renders_look_like_them(scene: tuple[Views, Views]) -> None:
    """A procedural scene as what a reconstruction might render: exact depth and normals, then refined."""
    views, held = scene
    world = random_scene("co3d", 0)
    cameras = random_cameras(world, 0, 14, 32, 32)
    similarity = normalize_scene(cameras)
    renders = _exact_renders(trace(world, cameras), similarity.cameras(cameras), similarity.scale)
    kept = [i for i in range(14) if i not in (4, 10)]
    splats = from_renders([renders[i] for i in kept], views.cameras)
    assert psnr(splats, held) > 17
    few = from_renders([renders[i] for i in kept], views.cameras, most=1000)
    assert len(few) <= 1000
    refined = train(SplatTrainer(dataclasses.replace(REFINE, iterations=60), views, 0, first=splats))
    assert psnr(refined, held) > psnr(splats, held) + 1
    assert len(refined) == len(splats)


def test_splats_need_one_camera_per_render(scene: tuple[Views, Views]) -> None:
    with pytest.raises(ValueError, match="one camera per render"):
        from_renders([], scene[0].cameras)


def _exact_renders(tracing, cameras: Cameras, scale: float) -> list[Render]:  # type: ignore[no-untyped-def]
    out = []
    for i in range(len(cameras)):
        seen = torch.isfinite(tracing.depth[i]) & (tracing.depth[i] > 0)
        depth = torch.where(seen, tracing.depth[i].float() * scale, 1e6)
        normals = normals_from_depth(depth, image_rays(cameras.to(dtype=torch.float32), i))
        image = tracing.image[i].permute(1, 2, 0).float()
        out.append(Render(image, depth, depth, seen.float(), normals))
    return out


def test_known_depths_are_where_splats_start_and_stay(scene: tuple[Views, Views]) -> None:
    """A wall two units before every camera, said by the views alone: their pictures are grey."""
    views, _ = scene
    grey = [torch.full((32, 32, 3), 128, dtype=torch.uint8)] * len(views)
    depths = [torch.full((32, 32), 2.0)] * len(views)
    known = Views.from_images(views.cameras, grey, views.captured, depths=depths)
    config = dataclasses.replace(SHORT, depth_prior=1.0, iterations=20, shell=0.0)
    trainer = SplatTrainer(config, known, 0)
    assert float(trainer.gaussians.means.norm(dim=-1).max()) < 4
    numbers = [trainer.step() for _ in range(20)]
    assert numbers[-1]["depth"] < 0.5 * numbers[0]["depth"]


def test_splats_keep_the_protocol(scene: tuple[Views, Views]) -> None:
    """From a request through a stopped training to tensors that render the same again."""
    views, held = scene
    request = ReconstructionRequest("tiny", {"iterations": 12, "start": 800, "most": 1000})
    made = Splats.from_request(request)
    json.dumps(made.settings)
    assert made.start(views, 0, "cpu") == []
    while made.iteration < 5:
        numbers = made.step()
    assert {"loss", "psnr", "rays"} <= set(numbers)
    again = Splats.from_request(request)
    again.start(views, 0, "cpu")
    again.load_state(made.state())
    for one in (made, again):
        while not one.finished:
            one.step()
    settings = json.loads(json.dumps(made.settings))
    stored = Splats.from_tensors(settings, made.tensors(), "cpu")
    images = [one.render(held.cameras, 0, 0.5).image for one in (made, again, stored)]
    assert images[0].shape == (16, 16, 3)
    assert torch.equal(images[0], images[1])
    assert torch.equal(images[0], images[2])
    assert stored.uncertainty(held.cameras, 0) is None
    with pytest.raises(ValueError, match="not trained further"):
        stored.start(views, 0, "cpu")


@pytest.mark.parametrize(
    ("preset", "overrides", "message"),
    [
        ("quick", {}, "preset: 'quick' is none of splats'"),
        ("fast", {"rays": 3}, "overrides: rays is not a setting of splats"),
        ("fast", {"degree": 5}, "overrides: .*degree 0, 1 or 2"),
    ],
)
def test_a_request_that_cannot_be_met_is_refused(preset: str, overrides: dict[str, int], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Splats.from_request(ReconstructionRequest(preset, overrides))


def test_cameras_between_others_look_where_both_look() -> None:
    world = random_scene("co3d", 0)
    cameras = random_cameras(world, 0, 10, 32, 24)
    every = between(cameras, 24)
    assert len(every) == 24
    assert len(between(cameras, 6)) == 6
    assert len(between(cameras[:2], 40)) == 40  # between what is between, too
    between(cameras[:2], 40).validate()
    assert len(between(cameras[0], 6)) == 1
    torch.testing.assert_close(every[:10].world_from_camera, cameras.world_from_camera.double())
    every.validate()
    shown = []
    for i in range(10, 24):
        off = (every.centers[i] - 0.5 * (cameras.centers[:, None] + cameras.centers[None])).norm(dim=-1)
        a, b = divmod(int(off.argmin()), 10)
        assert float(off.min()) < 1e-9
        forward = cameras.forward[a].double() + cameras.forward[b].double()
        shown.append(float(every.forward[i] @ forward / forward.norm()))
    assert min(shown) > 0.9, shown
