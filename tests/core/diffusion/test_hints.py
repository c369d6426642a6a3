"""Hints: what is known of targets beforehand, on the grid of the latents; networks that take them, and training."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from cat3d_core.diffusion import GuidanceConfig, ModelConfig, SamplerConfig, Schedule, TrainConfig, Trainer, sample
from cat3d_core.diffusion.conditioning import drop_condition, make_condition
from cat3d_core.diffusion.hint_bank import HintBank
from cat3d_core.diffusion.hints import CONFIDENCE, INVERSE_DEPTH, Corruption, corrupted, hint_latents, rescaled
from cat3d_core.diffusion.sampler import START, evaluations
from cat3d_core.diffusion.schedule import alpha_sigma
from cat3d_core.diffusion.training import diffusion_loss
from cat3d_core.rays import matrix_rays, raymap
from tests.core.diffusion.models import inputs, random_model, tiny
from tests.core.diffusion.test_unet import _cameras

CHANNELS = 12


def maps(views: int, seed: int = 0) -> dict[str, torch.Tensor]:
    g = torch.Generator().manual_seed(seed)
    found = {name: torch.rand(views, 16, 24, generator=g) for name in ("seen", "confidence", "inverse_depth", "spread")}
    return found | {"colour": torch.rand(views, 3, 16, 24, generator=g)}


def test_maps_are_means_over_the_latents_blocks():
    autoencoder, found = random_model().autoencoder, maps(3)
    out = hint_latents(autoencoder, found)
    assert out.shape == (3, CHANNELS, 2, 3)
    torch.testing.assert_close(out[:, :8], autoencoder.encode(found["colour"]))
    block = found["confidence"][1, 8:16, 16:24].mean()
    torch.testing.assert_close(out[1, CONFIDENCE, 1, 2], block)
    torch.testing.assert_close(out[2, INVERSE_DEPTH, 0, 0], found["inverse_depth"][2, :8, :8].mean())
    with pytest.raises(ValueError, match="missing: seen, spread"):
        hint_latents(autoencoder, {k: v for k, v in found.items() if k not in ("seen", "spread")})


def test_inverse_depths_fall_as_a_scene_grows():
    hints = torch.rand(2, 3, CHANNELS, 2, 2)
    out = rescaled(hints, torch.tensor([2.0, 1.0]))
    assert torch.equal(out[1], hints[1])
    assert torch.equal(out[0, :, :INVERSE_DEPTH], hints[0, :, :INVERSE_DEPTH])
    torch.testing.assert_close(out[0, :, INVERSE_DEPTH:] * 2, hints[0, :, INVERSE_DEPTH:])


def test_corruption_leaves_out_and_adds_as_often_as_it_says():
    hints = torch.ones(200, 5, CHANNELS, 8, 8)

    def run(**how: float) -> torch.Tensor:
        off = {"whole": 0.0, "view": 0.0, "masked": 0.0, "noisy": 0.0}
        return corrupted(hints, torch.Generator().manual_seed(0), Corruption(**(off | how)))

    assert torch.equal(run(), hints)
    whole = run(whole=0.5).amax((1, 2, 3, 4))
    assert 70 < int((whole == 0).sum()) < 130
    views = run(view=0.5).amax((2, 3, 4))
    assert 400 < int((views == 0).sum()) < 600
    masked = run(masked=1.0, most=0.4)
    assert 0.15 < float((masked == 0).float().mean()) < 0.25
    assert bool(((masked == 0).all(2) | (masked == 1).all(2)).all())  # all channels of a block, or none
    noisy = run(noisy=1.0, noise=0.3)
    assert torch.equal(noisy[:, :, 8:], hints[:, :, 8:])
    assert 0.1 < float((noisy - hints)[:, :, :8].std()) < 0.25
    assert torch.equal(run(noisy=0.5), run(noisy=0.5))


def test_hints_do_nothing_before_training_and_something_after():
    unet = random_model(hints=True).unet
    latents, time, cameras, mask = inputs(2, 4, 1)
    hints = torch.rand(2, 4, CHANNELS, 8, 8)
    assert unet.conv_in.in_channels == random_model().unet.conv_in.in_channels + CHANNELS
    with torch.no_grad():
        assert not torch.allclose(unet(latents, time, cameras, mask, hints), unet(latents, time, cameras, mask))
        unet.conv_in.weight[:, -CHANNELS:] = 0
        assert torch.equal(unet(latents, time, cameras, mask, hints), unet(latents, time, cameras, mask))


def test_models_without_hints_keep_their_configuration():
    assert not tiny().unet.hints
    old = tiny().to_json().replace('"hints": false, ', "")
    assert ModelConfig.from_json(old) == tiny()


def test_hints_belong_to_targets_and_are_dropped_with_the_rest():
    hints = torch.rand(2, 3, CHANNELS, 4, 4)
    condition = make_condition(torch.ones(2, 1, 8, 4, 4), torch.ones(2, 4, 4, 4), hints)
    assert condition.hints is not None
    assert not condition.hints[:, 0].any()
    assert torch.equal(condition.hints[:, 1:], hints)
    dropped = drop_condition(condition, torch.tensor([True, False]), "images").hints
    assert dropped is not None
    assert not dropped[0].any()
    assert torch.equal(dropped[1], condition.hints[1])


def groups(count: int, given: int = 3, targets: int = 5) -> tuple[torch.Tensor, ...]:
    latents, _, cameras, _ = inputs(count, given + targets, given)
    g = torch.Generator().manual_seed(9)
    hints = torch.rand(count, targets, CHANNELS, 8, 8, generator=g)
    return latents[:, :given], cameras, torch.randn(count, targets, 8, 8, 8, generator=g), hints


def test_groups_with_hints_are_sampled_alone_as_together_guided_or_not():
    model = random_model(hints=True)
    latents, cameras, noise, hints = groups(2, 3, 2)
    for scale in (1.0, 3.0):
        config = SamplerConfig(steps=3, guidance=GuidanceConfig(scale), micro_batch=1)
        both = sample(model, latents, cameras, noise, config, hints)
        alone = sample(model, latents[1:], cameras[1:], noise[1:], config, hints[1:])
        assert torch.equal(both[1:], alone)
        assert not torch.allclose(both, sample(model, latents, cameras, noise, config))


def test_a_start_from_hints_skips_the_noisiest_steps():
    """A network that knows nothing (predicts v = 0 at the start's level) shows what sampling starts from."""
    model = random_model(hints=True)
    latents, cameras, noise, hints = groups(1)
    config = SamplerConfig("ddim", "trailing", 4, GuidanceConfig(1.0), start="hint")
    schedule = Schedule(model.config.schedule, 5)
    levels = schedule.nodes("trailing", 4)
    kept = levels[levels >= START]
    assert 0 < len(kept) < 4
    assert evaluations(config, schedule, hinted=True) == len(kept)
    assert evaluations(config, schedule) == 4
    seen = []

    class Spy(torch.nn.Module):
        def forward(self, x, time, cameras, mask, hints=None):
            seen.append(x[:, 3:])
            return torch.zeros_like(x)

    model.unet = Spy()
    certain = hints.clone()
    certain[:, :, CONFIDENCE] = 1
    sample(model, latents, cameras, noise, config, certain)
    assert len(seen) == len(kept)
    alpha, sigma = (float(part) for part in alpha_sigma(kept[0]))
    torch.testing.assert_close(seen[0], alpha * certain[:, :, :8] + sigma * noise)
    certain[:, :, CONFIDENCE] = 0
    sample(model, latents, cameras, noise, config, certain)
    torch.testing.assert_close(seen[len(kept)], noise)


def test_certain_places_weigh_less_in_the_loss():
    latents, cameras, _, hints = groups(4)
    whole = torch.cat([latents, torch.randn(4, 5, 8, 8, 8)], 1)
    hints[:, :, CONFIDENCE] = 1

    class Zero(torch.nn.Module):
        def forward(self, x, time, cameras, mask, hints=None):
            return torch.zeros_like(x)

    def loss(weight: float) -> torch.Tensor:
        config = TrainConfig(drop_probability=0.0, hint_weight=weight)
        random = torch.Generator().manual_seed(4)
        return diffusion_loss(Zero(), Schedule(tiny().schedule, 5), whole, cameras, 3, random, config, hints)

    told = corrupted(hints, _after_noise(whole[:, 3:].shape))[:, :, CONFIDENCE].mean((1, 2, 3))
    ratio = loss(0.0) / loss(1.0)
    assert bool((ratio < 1).any())
    torch.testing.assert_close(ratio, 1 - told, atol=0.15, rtol=0)


def _after_noise(shape: torch.Size) -> torch.Generator:
    """The generator of `diffusion_loss` where hints are corrupted."""
    random = torch.Generator().manual_seed(4)
    torch.rand((), generator=random)
    torch.rand(shape[0], generator=random)
    torch.randn(shape, generator=random)
    return random


def test_training_moves_the_channels_for_hints():
    model = random_model(hints=True)
    with torch.no_grad():
        model.unet.conv_in.weight[:, -CHANNELS:] = 0
    trainer = Trainer(TrainConfig(learning_rate=1e-3, warmup_steps=1, precision="float32"), model, 0)
    latents, cameras, _, hints = groups(4)
    for _ in range(2):
        trainer.step(torch.cat([latents, torch.randn(4, 5, 8, 8, 8)], 1), cameras, 3, hints)
    assert trainer.ema_model().unet.conv_in.weight[:, -CHANNELS:].any()


def test_the_bank_draws_groups_with_as_many_given_views_as_asked_for():
    views, count = 6, 7
    cameras = [_cameras(views, s) for s in range(count)]
    marks = torch.arange(count).reshape(count, 1, 1, 1, 1)
    bank = HintBank(
        marks.expand(-1, views, 8, 4, 4).half(), marks.expand(-1, views, CHANNELS, 4, 4).half(),
        torch.stack([c.intrinsics for c in cameras]), torch.stack([c.world_from_camera for c in cameras]),
        torch.tensor([1, 3, 1, 3, 1, 3, 1]), torch.tensor([0, 0, 0, 0, 0, 9, 0]), 64,
    )  # fmt: skip
    latents, matrices, hints = bank.batch(40, 3, 0, "step")
    group = latents[:, 0, 0, 0, 0].long()
    assert set(group.tolist()) == {1, 3, 5}
    assert 8 < int((group == 5).sum()) < 32  # the small family as often as the large one
    assert hints.shape == (40, views - 3, CHANNELS, 4, 4)
    assert torch.equal(hints[:, 0, 0, 0, 0].long(), group)
    one = cameras[int(group[2])]
    torch.testing.assert_close(matrix_rays(matrices[2], 4, 4), raymap(one, one.world_from_camera[0], 4, 4))
    assert torch.equal(bank.batch(40, 3, 0, "step")[0], latents)
    alike = dataclasses.replace(bank, family=torch.zeros(count, dtype=torch.int64))
    assert set(alike.batch(40, 3, 0, "step")[0][:, 0, 0, 0, 0].tolist()) == {1.0, 3.0, 5.0}
    with pytest.raises(ValueError, match="no groups with 2 given views"):
        bank.batch(1, 2, 0)
    with pytest.raises(ValueError, match="needs hints"):
        dataclasses.replace(bank, hints=bank.hints[:2])
