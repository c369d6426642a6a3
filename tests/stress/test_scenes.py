"""Scenes that break others: each ends in finite numbers, or in an error that says what is wrong."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from torch import Tensor

from cat3d_core.alignment import align_cameras, pose_errors
from cat3d_core.cameras import Cameras
from cat3d_core.diffusion import GuidanceConfig, SamplerConfig, ScheduleConfig, sample
from cat3d_core.diffusion import training as diffusion_training
from cat3d_core.diffusion.conditioning import camera_vectors
from cat3d_core.diffusion.schedule import Schedule
from cat3d_core.metrics.perceptual import PerceptualDistance
from cat3d_core.metrics.psnr import psnr
from cat3d_core.metrics.ssim import ssim
from cat3d_core.normalization import Similarity, normalize_scene
from cat3d_core.plan import PlanConfig, make_plan
from cat3d_core.rays import Rays, image_rays, raymap, reference_from_image
from cat3d_core.reconstruction import Views
from cat3d_core.zipnerf import PRESETS, Field, Trainer, losses, render_image
from cat3d_core.zipnerf.gradients import safe_exp
from cat3d_core.zipnerf.render import Round, expected_depth, render_rays, weights_from_density
from tests.core.diffusion.models import random_model

F64 = torch.float64
TINY = dataclasses.replace(PRESETS["tiny"], iterations=40, warmup_iterations=4, batch_rays=192, samples=(8, 6))


def finite(*tensors: Tensor) -> bool:
    return all(bool(torch.isfinite(t).all()) for t in tensors)


# --- cameras ---


def _toward(center: list[float], target: list[float]) -> Tensor:
    """A pose at `center` that looks at `target`, the top of its image towards +z."""
    c, t = torch.tensor(center, dtype=F64), torch.tensor(target, dtype=F64)
    forward = torch.nn.functional.normalize(t - c, dim=0)
    up = torch.tensor([0.0, 0, 1] if abs(forward[2]) < 0.99 else [0.0, 1, 0], dtype=F64)
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, up), dim=0)
    pose = torch.eye(4, dtype=F64)
    pose[:3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward], 1)
    pose[:3, 3] = c
    return pose


def cameras_of(*poses: Tensor, width: int = 24, height: int = 16) -> Cameras:
    k = torch.tensor([[20.0, 0, width / 2], [0, 20, height / 2], [0, 0, 1]], dtype=F64)
    return Cameras(k.repeat(len(poses), 1, 1), torch.stack(poses), torch.tensor([[width, height]] * len(poses)))


LAYOUTS = {
    "one camera": cameras_of(_toward([1, 0, 0.3], [0, 0, 0])),
    "three coincident cameras": cameras_of(*[_toward([1, 0, 0.3], [0, 0, 0])] * 3),
    "one place, all ways": cameras_of(*(_toward([0, 0, 0], [math.cos(a), math.sin(a), 0]) for a in range(6))),
    "face to face": cameras_of(_toward([1, 0, 0], [0, 0, 0]), _toward([-1, 0, 0], [0, 0, 0])),
    "back to back": cameras_of(_toward([1, 0, 0], [2, 0, 0]), _toward([-1, 0, 0], [-2, 0, 0])),
    "half turn on the spot": cameras_of(_toward([0, 0, 0], [1, 0, 0]), _toward([0, 0, 0], [-1, 0, 0])),
    "on a line, parallel": cameras_of(*(_toward([x, 0, 0], [x, 5, 0]) for x in (0.0, 1.0, 2.0))),
    "straight down": cameras_of(*(_toward([x, 0, 2], [x, 0, 0]) for x in (0.0, 0.5))),
    "nearly coincident": cameras_of(_toward([1, 0, 0], [0, 0, 0]), _toward([1 + 1e-12, 0, 0], [0, 0, 0])),
}
WORLDS = {
    "as it is": Similarity(1.0, torch.eye(3, dtype=F64), torch.zeros(3, dtype=F64)),
    "tiny": Similarity(1e-6, torch.eye(3, dtype=F64), torch.zeros(3, dtype=F64)),
    "huge": Similarity(1e6, torch.eye(3, dtype=F64), torch.zeros(3, dtype=F64)),
    "far from the origin": Similarity(1.0, torch.eye(3, dtype=F64), torch.tensor([1e6, -1e6, 1e6], dtype=F64)),
}


@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize("layout", LAYOUTS)
def test_cameras_that_break_others(layout: str, world: str) -> None:
    cameras = WORLDS[world].cameras(LAYOUTS[layout])
    similarity = normalize_scene(cameras)
    assert similarity.scale > 0
    assert finite(similarity.rotation, similarity.translation, torch.tensor(similarity.scale))
    normalised = similarity.cameras(cameras)
    maps = raymap(normalised, normalised.world_from_camera[0], 4, 6)
    assert finite(maps, raymap(normalised, normalised.world_from_camera[0], 4, 6, plucker=True))
    assert finite(camera_vectors(reference_from_image(normalised, normalised.world_from_camera[0])))
    assert maps[:, 3:].norm(dim=1).sub(1).abs().max() < 1e-12
    plan = make_plan(cameras, PlanConfig(count=12))
    assert finite(plan.cameras.world_from_camera, plan.cameras.intrinsics)
    plan.cameras.validate()
    errors = pose_errors(cameras, cameras)
    assert finite(errors.center_share)
    assert errors.rotation_deg.max() < 1e-3
    assert math.isfinite(align_cameras(cameras, LAYOUTS[layout]).scale)


def test_no_cameras_and_broken_ones_are_named() -> None:
    with pytest.raises(ValueError, match="at least one"):
        normalize_scene(cameras_of(torch.eye(4, dtype=F64))[[]])
    broken = torch.eye(4, dtype=F64)
    broken[0, 3] = math.nan
    with pytest.raises(ValueError, match="NaN"):
        normalize_scene(cameras_of(broken))
    with pytest.raises(ValueError, match="NaN"):
        make_plan(cameras_of(broken))


# --- images ---

IMAGES = {
    "white": torch.ones(1, 3, 40, 40),
    "black": torch.zeros(1, 3, 40, 40),
    "one pixel": torch.full((1, 3, 1, 1), 0.3),
    "1 x 4096": torch.rand(1, 3, 1, 4096, generator=torch.Generator().manual_seed(0)),
}


@pytest.mark.parametrize("name", IMAGES)
def test_metrics_of_images_that_break_others(name: str) -> None:
    image = IMAGES[name]
    other = (image + 0.25).remainder(1.0).requires_grad_()
    assert psnr(image, image).item() == math.inf
    value = psnr(other, image).sum()
    value.backward()
    assert finite(value, other.grad)  # type: ignore[arg-type]
    same = image.clone().requires_grad_()
    psnr(same, image).sum().backward()
    assert (same.grad == 0).all()  # type: ignore[union-attr]
    for window in ("gaussian_valid", "gaussian_same", "uniform_valid"):
        if min(image.shape[2:]) < 7 and window != "gaussian_same":
            with pytest.raises(ValueError, match="needs at least"):
                ssim(image, image, window)
            continue
        assert ssim(image, image, window).item() == 1.0
        x = other.detach().clone().requires_grad_()
        measured = ssim(x, image, window).sum()
        measured.backward()
        assert finite(x.grad)  # type: ignore[arg-type]
        assert -1 <= measured.item() <= 1
    network = PerceptualDistance("lpips-squeeze")
    if min(image.shape[2:]) < network.architecture.smallest:
        with pytest.raises(ValueError, match="at least"):
            network(image, image)
        return
    x = image.clone().requires_grad_()
    distance = network(x, image).sum()
    distance.backward()
    assert distance.item() == 0
    assert finite(x.grad)  # type: ignore[arg-type]


# --- rays and fields ---


@pytest.mark.parametrize("raw", [-math.inf, -1e30, -200.0, 0.0, 200.0, 1e30, math.inf])
def test_rays_through_nothing_and_through_walls(raw: float) -> None:
    logit = torch.full((2, 6), raw, requires_grad=True)
    t = torch.tensor([[0.0, 1e-6, 0.5, 0.5, 1.0, 1e3, 1e6]]).expand(2, 7)
    weights = weights_from_density(safe_exp(logit), t, torch.tensor([[0.0, 0, 1]]).expand(2, 3))
    final = Round(t / 1e6, t, weights)
    loss = losses.distortion(final, TINY) + losses.interlevel([final], final, (0.03,)) + expected_depth(final).mean()
    loss.backward()
    assert finite(weights, loss, logit.grad)  # type: ignore[arg-type]
    assert (weights.sum(-1) <= 1 + 1e-6).all()
    if raw <= -200:
        assert (expected_depth(final) == 1e6).all()
    if raw >= 200:
        assert weights.sum(-1).sub(1).abs().max() < 1e-6


@pytest.mark.parametrize("bias", [-1e6, 1e6])
@pytest.mark.parametrize("far", [1e6, 1e12])
def test_empty_and_solid_fields_render_and_learn(bias: float, far: float) -> None:
    field = Field(dataclasses.replace(TINY, near=0.0, far=far))
    with torch.no_grad():
        for grid in field.grids:
            grid.density.bias.fill_(bias)
    rays = image_rays(cameras_of(_toward([1, 0, 0.3], [0, 0, 0])).to(dtype=torch.float32), 0)
    out = render_rays(field, rays, generator=torch.Generator().manual_seed(0))
    loss = out.rgb.square().mean() + losses.distortion(out.rounds[-1], TINY)
    loss = loss + losses.interlevel(out.rounds[:-1], out.rounds[-1], TINY.interlevel_blur)
    loss.backward()
    gradients = [p.grad for p in field.parameters() if p.grad is not None]
    assert finite(out.rgb, loss, *gradients)
    assert (out.opacity < 1e-6).all() if bias < 0 else (out.opacity > 1 - 1e-5).all()


def _views(cameras: Cameras, *levels: int) -> Views:
    sizes = cameras.size.tolist()
    images = [torch.full((h, w, 3), level, dtype=torch.uint8) for level, (w, h) in zip(levels, sizes, strict=True)]
    return Views.from_images(cameras, images, torch.ones(len(levels), dtype=torch.bool))


def _train(views: Views, steps: int = 40, **changes: object) -> Trainer:
    trainer = Trainer(dataclasses.replace(TINY, **changes), views, seed=0)  # type: ignore[arg-type]
    for _ in range(steps):
        terms = trainer.step()
        assert all(math.isfinite(v) for name, v in terms.items() if name != "psnr"), terms
    assert trainer.skipped == 0
    return trainer


def test_contradictory_views_train_to_the_least_possible_loss() -> None:
    """The same camera has seen black and white: any grey between is 0.5 off on average."""
    pose = _toward([1, 0, 0.3], [0, 0, 0])
    cameras = cameras_of(pose, pose)
    trainer = _train(_views(cameras, 0, 255), 80, iterations=80)
    assert trainer.step()["photometric"] == pytest.approx(0.5, abs=0.1)
    assert finite(render_image(trainer.field, cameras.to(dtype=torch.float32), 0).image)


@pytest.mark.parametrize(("width", "height"), [(1, 1), (4096, 1), (1, 300)])
def test_fields_of_images_that_break_others(width: int, height: int) -> None:
    cameras = cameras_of(_toward([1, 0, 0.3], [0, 0, 0]), width=width, height=height)
    trainer = _train(_views(cameras, 200), 5)
    out = render_image(trainer.field, cameras.to(dtype=torch.float32), 0)
    assert out.image.shape == (height, width, 3)
    assert finite(out.image, out.depth, out.depth_mean, out.opacity, out.normals)


@pytest.mark.parametrize("level", [0, 255])
def test_black_and_white_scenes(level: int) -> None:
    cameras = LAYOUTS["face to face"]
    trainer = _train(_views(cameras, level, level))
    assert finite(render_image(trainer.field, cameras.to(dtype=torch.float32), 1).image)


@pytest.mark.parametrize("shift", [0.0, 1e-12, 1e3, 1e6])
def test_far_away_and_coincident_rays(shift: float) -> None:
    field = Field(TINY)
    directions = torch.tensor([[0.0, 0, 1], [0, 0, -1], [1e-12, 0, -1], [3.0, 3, 1]])
    out = render_rays(field, Rays(torch.full((4, 3), shift), directions, torch.full((4, 1), 1e-3)))
    assert finite(out.rgb, out.opacity)


def test_a_gradient_that_adam_cannot_square_is_skipped(monkeypatch: pytest.MonkeyPatch) -> None:
    """Found by `cat3d stress`: beyond 1e19 the second moment became infinite and its parameter never moved again."""
    views = _views(LAYOUTS["face to face"], 10, 20)
    trainer = Trainer(TINY, views, seed=0)
    trainer.step()
    sound = losses.charbonnier
    monkeypatch.setattr(losses, "charbonnier", lambda d, eps: sound(d, eps) * 1e25)
    assert trainer.step()["skipped"] == 1
    monkeypatch.undo()
    trainer.step()
    assert finite(*trainer.adam.square.values(), *trainer.field.parameters())


@pytest.mark.slow
@pytest.mark.timeout(1500)
def test_ten_thousand_steps_without_a_non_finite_one() -> None:
    """Contradictory views, far 1e6, the learning rate of the paper all along."""
    cameras = Cameras.cat([LAYOUTS["face to face"], LAYOUTS["one camera"], LAYOUTS["one camera"]])
    _train(
        _views(cameras, 0, 255, 255, 0), 10_000, iterations=10_000, lr_final=0.04, batch_rays=32, chunk_rays=32,
        samples=(6, 4), grid_max=(32, 32), grid_log2_table=10,
    )  # fmt: skip


# --- diffusion ---


def _group(targets: int = 5, same: bool = False) -> tuple[Tensor, Tensor, Tensor]:
    """Latents, cameras and noise of one group; with `same`, all views are one camera that sees one picture."""
    g = torch.Generator().manual_seed(0)
    count = 3 + targets
    poses = [_toward([math.cos(a), math.sin(a), 0.2], [0, 0, 0]) for a in range(count)]
    cameras = cameras_of(*(poses[:1] * count if same else poses), width=64, height=64)
    matrices = reference_from_image(cameras, cameras.world_from_camera[0])[None]
    latents = torch.randn(1, 3, 8, 8, 8, generator=g)
    latents = latents[:, :1].expand(1, 3, 8, 8, 8) if same else latents
    return latents, matrices, torch.randn(1, targets, 8, 8, 8, generator=g)


@pytest.mark.parametrize("scale", [0.0, 1.0, 30.0])
@pytest.mark.parametrize("solver", ["ddim", "dpm++", "unipc"])
@pytest.mark.parametrize("same", [False, True])
def test_guidance_and_conditioning_equal_to_targets(scale: float, solver: str, same: bool) -> None:
    config = SamplerConfig(solver, steps=4, guidance=GuidanceConfig(scale=scale))  # type: ignore[arg-type]
    out = sample(random_model(), *_group(same=same), config)
    assert out.dtype == torch.float32
    assert finite(out)


@pytest.mark.parametrize("nodes", ["trailing", "linspace", "log_snr", "karras"])
@pytest.mark.parametrize("solver", ["ddim", "dpm++", "unipc"])
@pytest.mark.parametrize("terminal", [True, False])
def test_any_number_of_steps(nodes: str, solver: str, terminal: bool) -> None:
    """With a perfect network all of 1 to 2,000 steps land on the clean latent; none, or more than the table has, are
    refused with a sentence."""
    from cat3d_core.diffusion.solvers import integrate

    schedule = Schedule(ScheduleConfig(zero_terminal_snr=terminal), 5)
    clean = torch.randn(4, generator=torch.Generator().manual_seed(0))
    noise = torch.randn(4, generator=torch.Generator().manual_seed(1))
    for steps in (0, 1, 2, 3, 50, 1000, 1001, 2000):
        if steps < 1 or (steps > 1000 and nodes in ("trailing", "linspace")):
            with pytest.raises(ValueError, match="steps"):
                schedule.nodes(nodes, steps)  # type: ignore[arg-type]
            continue
        places = schedule.nodes(nodes, steps)  # type: ignore[arg-type]
        assert (places.diff() > 0).all()
        out = integrate(noise, torch.cat([places, places.new_tensor([math.inf])]), lambda x, i: clean, solver)  # type: ignore[arg-type]
        torch.testing.assert_close(out, clean, rtol=1e-5, atol=1e-5)


def test_epsilon_prediction_needs_a_terminal_signal() -> None:
    with pytest.raises(ValueError, match="zero terminal SNR"):
        ScheduleConfig(prediction="eps", zero_terminal_snr=True)
    schedule = Schedule(ScheduleConfig(zero_terminal_snr=True), 5)
    assert schedule.log_snr[-1] == -math.inf
    assert finite(schedule.time(schedule.log_snr))
    assert finite(schedule.clean(torch.ones(3), torch.ones(3), schedule.log_snr[-1]))


def test_autoencoder_of_images_that_break_others() -> None:
    """Found by `cat3d stress`: an empty batch failed inside torch's pixel unshuffle, about channels."""
    autoencoder = random_model().autoencoder
    for image in (torch.zeros(1, 3, 16, 16), torch.ones(1, 3, 8, 64), torch.full((2, 3, 8, 8), 0.5)):
        latents = autoencoder.encode(image)
        assert finite(latents, autoencoder.decode(latents), autoencoder.decode(latents * 1e6))
    for shape in ((0, 3, 16, 16), (1, 3, 1, 4096), (1, 3, 1, 1)):
        with pytest.raises(ValueError, match="multiples of 8"):
            autoencoder.encode(torch.zeros(shape))


@pytest.mark.slow
@pytest.mark.timeout(1500)
def test_a_thousand_steps_of_the_network() -> None:
    """One view given, one sampled: the smallest group there is."""
    model = random_model()
    model.config = dataclasses.replace(model.config, views=2)
    latents, maps, noise = _group(1)
    config = SamplerConfig("unipc", "log_snr", 1000, GuidanceConfig(scale=3.0))
    assert finite(sample(model, latents[:, :1], maps[:, [0, 3]], noise, config))


def test_training_on_identical_views_and_a_gradient_that_is_not_finite(monkeypatch: pytest.MonkeyPatch) -> None:
    """Found here: with a finite loss and an infinite gradient, clipping made every weight NaN."""
    model = random_model()
    config = diffusion_training.TrainConfig(precision="float32", warmup_steps=0)
    trainer = diffusion_training.Trainer(config, model, seed=0)
    latents, maps, _ = _group(same=True)
    views = latents[:, :1].expand(1, 8, 8, 8, 8)
    for constant in (views, torch.zeros_like(views), torch.full_like(views, 1e3)):
        assert math.isfinite(trainer.step(constant, maps, 3)["loss"])
    before = [master.clone() for master in trainer.masters]
    sound = diffusion_training.diffusion_loss

    def overflowing(unet: torch.nn.Module, *arguments: object) -> Tensor:
        weight = next(unet.parameters())
        return sound(unet, *arguments) + ((weight - weight.detach()) * 1e30 * 1e30).sum()  # type: ignore[arg-type]

    monkeypatch.setattr(diffusion_training, "diffusion_loss", overflowing)
    with pytest.raises(FloatingPointError, match="gradient"):
        trainer.step(views, maps, 3)
    assert all(torch.equal(a, b) for a, b in zip(before, trainer.masters, strict=True))
    monkeypatch.undo()
    assert math.isfinite(trainer.step(views, maps, 3)["loss"])
