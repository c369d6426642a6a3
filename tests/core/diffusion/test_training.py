"""Training: targets only, exact resumption, drop, accumulation, data-parallel ranks; and the bank of latents."""

from __future__ import annotations

import dataclasses
import math
import os

import pytest
import torch

from cat3d_core.diffusion import (
    LatentBank,
    MultiViewModel,
    Schedule,
    TrainConfig,
    Trainer,
    diffusion_loss,
    load_state,
    save_state,
)
from cat3d_core.diffusion.training import _snr_weight
from cat3d_core.rays import matrix_rays, raymap
from tests.core.diffusion.models import matrices, random_model, tiny
from tests.core.diffusion.test_unet import _cameras

CONFIG = TrainConfig(learning_rate=1e-3, warmup_steps=2, total_steps=20, precision="float32")


def _batch(step: int, groups: int = 4) -> tuple[torch.Tensor, torch.Tensor]:
    g = torch.Generator().manual_seed(step)
    return torch.randn(groups, 8, 8, 8, 8, generator=g).half(), matrices(groups, 8, g)


def test_loss_is_on_targets_only_with_clean_conditioning():
    model = random_model()
    latents, cameras = _batch(0)
    seen = {}

    class Spy(torch.nn.Module):
        def forward(self, x, time, cameras, mask, hints=None):
            seen.update(x=x, mask=mask, cameras=cameras)
            out = torch.zeros_like(x)
            out[:, :3] = 1e6  # whatever the network says about conditioning views does not count
            return out

    schedule = Schedule(model.config.schedule, 5)
    config = dataclasses.replace(CONFIG, drop_probability=0.0)
    loss = diffusion_loss(Spy(), schedule, latents, cameras, 3, torch.Generator().manual_seed(0), config)
    assert torch.equal(seen["x"][:, :3], latents[:, :3].float())
    assert seen["mask"].tolist() == [[1] * 3 + [0] * 5] * 4
    # A zero prediction of v leaves E[v^2] = alpha^2 + sigma^2 E[clean^2] = 1 for unit latents.
    assert loss.shape == (4,)
    assert abs(float(loss.mean()) - 1) < 0.1
    config = dataclasses.replace(CONFIG, drop_probability=1.0)
    diffusion_loss(Spy(), schedule, latents, cameras, 3, torch.Generator().manual_seed(0), config)
    assert seen["x"][:, :3].abs().sum() == 0
    assert seen["mask"].sum() == 0
    assert seen["cameras"].abs().sum() == 0


def test_min_snr_weights():
    log_snr = torch.tensor([-math.inf, 0.0, 2.0, 10.0], dtype=torch.float64)
    snr = log_snr.exp()
    torch.testing.assert_close(_snr_weight(log_snr, "v", 5.0), snr.clamp(max=5) / (snr + 1))
    torch.testing.assert_close(_snr_weight(log_snr[1:], "eps", 5.0), (5 / snr[1:]).clamp(max=1))
    assert _snr_weight(log_snr, "v", None).eq(1).all()


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_resumed_run_is_bit_identical(precision, tmp_path):
    config = dataclasses.replace(CONFIG, precision=precision, accumulate=2)
    model = MultiViewModel(tiny())
    straight = Trainer(config, model, seed=3)
    for i in range(7):
        straight.step(*_batch(i), 1 + 2 * (i % 2))
    first = Trainer(config, model, seed=3)
    for i in range(3):  # stopped in the middle of an accumulation
        first.step(*_batch(i), 1 + 2 * (i % 2))
    save_state(tmp_path / "state.safetensors", first.state(), {"note": 1})
    second = Trainer(config, MultiViewModel(tiny()), seed=0)
    second.load_state(load_state(tmp_path / "state.safetensors")[0])
    for i in range(3, 7):
        second.step(*_batch(i), 1 + 2 * (i % 2))
    ours, theirs = second.state(), straight.state()
    assert ours.keys() == theirs.keys()
    for key in ours:
        assert torch.equal(ours[key], theirs[key]), key


def test_state_of_another_network_is_refused():
    state = Trainer(CONFIG, MultiViewModel(tiny()), 0).state()
    with pytest.raises(ValueError, match="another|other weights"):
        Trainer(
            CONFIG, MultiViewModel(tiny(channels=(32, 64, 64), heads=(1, 2, 2), attention=(True,) * 3)), 0
        ).load_state(state)


@pytest.mark.parametrize("precision", ["float32", pytest.param("bfloat16", marks=pytest.mark.slow)])
def test_it_learns_a_constant(precision):
    """One picture repeated: the loss (1 at the start, when the network says zero) falls, and the average follows."""
    config = TrainConfig(
        learning_rate=4e-3, final_learning_rate=1e-3, warmup_steps=3, total_steps=40, ema_decay=0.8, precision=precision
    )
    trainer = Trainer(config, MultiViewModel(tiny()), 0)
    picture = torch.randn(1, 1, 8, 8, 8, generator=torch.Generator().manual_seed(9))
    latents, cameras = picture.expand(2, 8, 8, 8, 8), _batch(0, 2)[1]
    losses = [trainer.step(latents, cameras, 3)["loss"] for _ in range(40)]
    assert sum(losses[:3]) / 3 > 0.8
    assert sum(losses[-10:]) / 10 < 0.5
    model, schedule = trainer.ema_model(), Schedule(trainer.model_config.schedule, 5)
    with torch.no_grad():
        averaged = diffusion_loss(model.unet, schedule, latents, cameras, 3, torch.Generator().manual_seed(1), config)
    assert float(averaged.mean()) < 0.5


def test_learning_rate_rises_then_falls():
    config = TrainConfig(learning_rate=1.0, final_learning_rate=0.1, warmup_steps=10, total_steps=110)
    assert config.learning_rate_at(0) == pytest.approx(0.1)
    assert config.learning_rate_at(9) == config.learning_rate_at(10) == pytest.approx(1.0)
    assert config.learning_rate_at(60) == pytest.approx(0.55)
    assert config.learning_rate_at(500) == pytest.approx(0.1)


def test_a_loss_that_is_not_finite_stops_the_training():
    trainer = Trainer(CONFIG, MultiViewModel(tiny()), 0)
    latents, cameras = _batch(0)
    with pytest.raises(FloatingPointError, match="learning rate"):
        trainer.step(latents * math.inf, cameras, 1)
    assert trainer.steps == 0


def _rank(rank: int, folder: str) -> None:
    torch.set_num_threads(1)
    os.environ.update(MASTER_ADDR="127.0.0.1", RANK=str(rank), WORLD_SIZE="2")
    torch.distributed.init_process_group("gloo", init_method=f"file://{folder}/store", rank=rank, world_size=2)
    torch.manual_seed(0)
    trainer = Trainer(CONFIG, MultiViewModel(tiny()), 0)
    for i in range(3):
        trainer.step(*_batch(10 * i + rank), 1)
    save_state(f"{folder}/{rank}.safetensors", trainer.state(), {})
    torch.distributed.destroy_process_group()


@pytest.mark.slow
def test_ranks_stay_equal_and_average_their_gradients(tmp_path):
    torch.multiprocessing.spawn(_rank, (str(tmp_path),), nprocs=2)
    first, second = (load_state(tmp_path / f"{r}.safetensors")[0] for r in (0, 1))
    for key in first:
        assert torch.equal(first[key], second[key]), key


def _bank(scenes: int = 6, views: int = 12) -> LatentBank:
    cameras = [_cameras(views, s) for s in range(scenes)]
    marks = torch.arange(scenes * views).reshape(scenes, views, 1, 1, 1).expand(-1, -1, 2, 4, 4)
    return LatentBank(
        marks.half(),
        torch.stack([c.intrinsics for c in cameras]),
        torch.stack([c.world_from_camera for c in cameras]),
        torch.tensor([0, 0, 0, 0, 0, 1]),
        64,
    )


def test_bank_draws_groups_of_one_scene_with_matching_rays():
    bank = _bank()
    latents, cameras = bank.batch(40, 5, 0, "step", 1)
    marks = latents[:, :, 0, 0, 0].long()
    scene, view = marks // 12, marks % 12
    assert (scene == scene[:, :1]).all()
    assert all(len(v.unique()) == 5 for v in view)
    assert 8 < (scene[:, 0] == 5).sum() < 32  # the small family as often as the big one
    chosen = _cameras(12, int(scene[7, 0]))[view[7]]
    expected = raymap(chosen, chosen.world_from_camera[0], 4, 4)
    torch.testing.assert_close(matrix_rays(cameras[7], 4, 4), expected, rtol=0, atol=1e-12)
    again, _ = bank.batch(40, 5, 0, "step", 1)
    other, _ = bank.batch(40, 5, 0, "step", 2)
    assert torch.equal(again, latents)
    assert not torch.equal(other, latents)


def test_bank_spread_limits_the_distance():
    bank = _bank(2, 12)
    bank = LatentBank(bank.latents, bank.intrinsics, bank.world_from_camera, torch.tensor([0, 1]), 64)

    def width(spread: float) -> float:
        _, cameras = bank.batch(60, 4, 0, 1, spread=spread)
        return float(cameras[:, 1:, :3, 3].norm(dim=-1).mean())

    assert width(0.35) < width(1.0)


def test_bank_of_mismatched_shapes_is_refused():
    bank = _bank()
    with pytest.raises(ValueError, match="intrinsics"):
        LatentBank(bank.latents, bank.intrinsics[:2], bank.world_from_camera, bank.family, 64)


@pytest.mark.parametrize("what", ["position", "direction"])
def test_a_narrow_group_is_the_nearest_views_in_position_and_direction(what: str) -> None:
    """Two cameras beside each other that look alike, and two elsewhere or that look elsewhere."""
    bank = _bank(2, 12)
    poses = torch.eye(4, dtype=torch.float64).repeat(2, 12, 1, 1)
    far = torch.arange(12) >= 6
    if what == "position":
        poses[:, far, 0, 3] = 1.0
    else:
        poses[:, far, 0, 0] = poses[:, far, 2, 2] = -1.0
    bank = LatentBank(bank.latents, bank.intrinsics, poses, torch.tensor([0, 1]), 64)
    latents, _ = bank.batch(40, 4, 0, "step", spread=0.5)
    there = latents[:, :, 0, 0, 0].long() % 12 >= 6
    assert (there == there[:, :1]).all()
    assert 0 < int(there[:, 0].sum()) < 40
    # One camera apart from eleven: only groups round itself show it.
    poses = torch.eye(4, dtype=torch.float64).repeat(2, 12, 1, 1)
    poses[:, 11] = bank.world_from_camera[0, 11]
    lone = LatentBank(bank.latents, bank.intrinsics, poses, torch.tensor([0, 1]), 64)
    latents, _ = lone.batch(60, 6, 0, "lone", spread=0.5)
    assert 0 < int((latents[:, :, 0, 0, 0].long() % 12 == 11).any(1).sum()) < 20


def test_a_step_says_the_learning_rate_that_it_took():
    config = dataclasses.replace(CONFIG, warmup_steps=3, accumulate=2)
    trainer = Trainer(config, MultiViewModel(tiny()), seed=0)
    said = [trainer.step(*_batch(i, 1), 3) for i in range(6)]
    assert [numbers["step"] for numbers in said] == [0, 1, 1, 2, 2, 3]
    taken = [config.learning_rate_at(max(0, int(numbers["step"]) - 1)) for numbers in said]
    assert [numbers["lr"] for numbers in said] == pytest.approx(taken)
    assert trainer.optimizer.param_groups[0]["lr"] == pytest.approx(config.learning_rate_at(2))
