"""What reconstruction may leave out: off it changes nothing, on it changes no more than it says."""

import dataclasses
import math

import pytest
import torch

from cat3d_core.rays import image_rays
from cat3d_core.zipnerf import PRESETS, Trainer, render_image
from cat3d_core.zipnerf.field import GridDensity
from cat3d_core.zipnerf.frustums import grid_samples
from cat3d_core.zipnerf.render import query_rays, render_rays, weights_from_density
from tests.core.zipnerf.test_training import TINY, _views


def _distance(prediction: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    return (prediction - target).square().mean((1, 2, 3))


def _trained(steps: int = 12, perceptual: bool = False, **changes: object) -> Trainer:
    config = dataclasses.replace(TINY, batch_rays=512, patch_size=16, patch_share=0.5, **changes)  # type: ignore[arg-type]
    trainer = Trainer(config, _views(), seed=3, perceptual=_distance if perceptual else None)
    for _ in range(steps):
        trainer.step()
    return trainer


@pytest.mark.parametrize("preset", PRESETS)
def test_the_papers_preset_skips_nothing(preset: str) -> None:
    if preset == "paper":
        config = PRESETS[preset]
        assert (config.proposal_every, config.lpips_every, config.low_resolution_iterations) == (1, 1, 0)
        assert (config.skip_transmittance, config.plateau_patience) == (0.0, 0)


@pytest.mark.parametrize(
    "unused",
    [
        {"skip_groups": 7},
        {"lpips_every": 5},  # no perceptual distance is given
        {"plateau_every": 2, "plateau_tolerance": 0.5, "plateau_cooldown": 0.0},
    ],
)
def test_a_skip_that_is_off_changes_no_bit(unused: dict) -> None:
    plain, other = _trained(), _trained(**unused)
    for name, value in plain.state().items():
        assert torch.equal(value, other.state()[name]), name
    images = [render_image(t.field, t.views.cameras, 0).image for t in (plain, other)]
    assert torch.equal(*images)


def test_front_to_back_loses_less_than_its_bound() -> None:
    trainer = _trained(12)
    with torch.no_grad():
        trainer.field.grids[-1].density.bias += 4.0  # type: ignore[operator]  # solid surfaces
    rays = image_rays(trainer.views.cameras, 0)
    whole = render_rays(trainer.field, rays)
    for bound in (0.1, 1e-3):
        config = dataclasses.replace(trainer.config, skip_transmittance=bound)
        some = render_rays(trainer.field, rays, train_proposals=False, config=config)
        skipped = (some.rounds[-1].weights == 0) & (whole.rounds[-1].weights > 0)
        assert skipped.any()
        # The samples of the final round move a little where proposals were skipped too, hence the factor.
        assert (some.rgb - whole.rgb).abs().max() < 3 * bound
        assert (whole.opacity - some.opacity).abs().max() < 3 * bound


@pytest.mark.parametrize("bound", [0.1, 1e-2, 1e-3])
def test_skipped_intervals_carry_no_more_gradient_than_the_bound(bound: float) -> None:
    """The same samples, with and without: weights and the gradient of the table differ by the light that is left."""
    generator = torch.Generator().manual_seed(0)
    torch.manual_seed(0)  # for the layers of the grid
    grid = GridDensity(dataclasses.replace(TINY, grid_init=0.5), 1)
    with torch.no_grad():
        grid.table.uniform_(-0.5, 0.5, generator=generator)
        grid.density.bias += 2.5
    rays = image_rays(_views().cameras, 0)
    t = torch.linspace(0.2, 2.5, 17).expand(len(rays.origins), 17)
    positions, std = grid_samples(rays, t)
    lengths = t.diff(dim=-1) * rays.directions.norm(dim=-1, keepdim=True)
    target = torch.rand((len(t), 16), generator=generator)
    found = []
    for limit in (0.0, bound):
        density, parts = query_rays(grid, positions, std, lengths, limit, 4)
        weights = weights_from_density(density, t, rays.directions)
        (gradient,) = torch.autograd.grad((weights * target).sum(), density)
        found.append((weights, gradient, sum(part.hidden.shape[0] * part.hidden.shape[1] for part in parts)))
    (weights, gradient, all_queried), (fewer, less, queried) = found
    assert queried < all_queried
    assert (weights - fewer).sum(1).max() <= bound
    assert (gradient - less).abs().max() <= bound * float(lengths.max())  # d w / d density = length * light


def test_all_rays_may_end_in_the_first_group() -> None:
    trainer = _trained(1)
    with torch.no_grad():
        trainer.field.grids[-1].density.bias += 35.0  # type: ignore[operator]
    config = dataclasses.replace(trainer.config, skip_transmittance=0.01)
    trainer.config = config
    assert math.isfinite(trainer.step()["loss"])
    assert torch.isfinite(render_image(trainer.field, trainer.views.cameras, 0, config).image).all()


def test_front_to_back_trains_as_well() -> None:
    plain, skipping = _trained(12), _trained(12, skip_transmittance=0.01)
    assert skipping.step()["psnr"] == pytest.approx(plain.step()["psnr"], abs=1.0)
    again = _trained(12, skip_transmittance=0.01)
    again.step()
    assert all(torch.equal(value, skipping.state()[name]) for name, value in again.state().items())


@pytest.mark.slow
def test_perceptual_loss_at_every_kth_step_keeps_its_weight_in_expectation() -> None:
    every, third = (_trained(0, perceptual=True, lpips_every=k, lpips_weight=0.2, lr_init=1e-9, lr_final=1e-9)
                    for k in (1, 3))  # fmt: skip
    sums = [[trainer.step().get("perceptual") for _ in range(60)] for trainer in (every, third)]
    assert all((value is not None) == (step % 3 == 0) for step, value in enumerate(sums[1]))
    totals = [sum(value or 0.0 for value in values) for values in sums]
    assert totals[1] == pytest.approx(totals[0], rel=0.25)  # 60 against 20 random patches


def test_proposals_rest_between_their_steps() -> None:
    trainer = _trained(4, proposal_every=3)
    for step in range(4, 10):
        before = trainer.field.grids[0].table.clone()  # type: ignore[operator]
        losses = trainer.step()
        moved = not torch.equal(before, trainer.field.grids[0].table)  # type: ignore[arg-type]
        assert moved == ("interlevel" in losses) == (step % 3 == 0)


def test_half_size_first_without_patches() -> None:
    """Patches need not fit the halved views: they are drawn afterwards."""
    trainer = _trained(0, perceptual=True, low_resolution_iterations=2)  # 24x20 pixels: halved smaller than a patch
    seen = ["perceptual" in trainer.step() for _ in range(4)]
    assert seen == [False, False, True, True]


def test_a_plateau_cuts_the_schedule_short_and_cools_down() -> None:
    config = dataclasses.replace(TINY, iterations=1000, plateau_patience=2, plateau_every=5, plateau_tolerance=0.9)
    trainer = Trainer(config, _views(), seed=0)
    rates = []
    while not trainer.finished:
        rates.append(trainer.step()["lr"])
    # The second check in a row without a tenfold fall (the first after warm-up is at step 5), then a tenth of 1,000.
    assert trainer.plateau_at == 15
    assert trainer.iteration == 115
    assert rates[-1] == pytest.approx(config.lr_final, rel=0.05)
    later = Trainer(dataclasses.replace(config, plateau_from=0.05), _views(), seed=0)
    while later.plateau_at < 0:
        later.step()
    assert later.plateau_at == 65  # the second check after the first at 55: none at 50 or before
    noisy = Trainer(dataclasses.replace(config, plateau_tolerance=0.0, iterations=40), _views(), seed=0)
    while not noisy.finished:
        noisy.step()
    assert noisy.iteration == 40  # it still learns


def test_a_cooling_run_goes_on_where_it_stopped() -> None:
    config = dataclasses.replace(TINY, iterations=200, plateau_patience=1, plateau_every=5, plateau_tolerance=0.9)
    whole = Trainer(config, _views(), seed=0)
    while not whole.finished:
        if whole.iteration == whole.plateau_at + 5:
            state = whole.state()
        whole.step()
    again = Trainer(config, _views(), seed=0)
    again.load_state(state)
    while not again.finished:
        again.step()
    assert all(torch.equal(value, again.state()[name]) for name, value in whole.state().items())
