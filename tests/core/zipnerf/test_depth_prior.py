"""Depths known beforehand: the loss on inverse depth in closed form, its fall, and what training makes of it."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from cat3d_core.cameras import Cameras
from cat3d_core.rays import image_rays
from cat3d_core.reconstruction import Views
from cat3d_core.zipnerf import PRESETS, Trainer, losses
from cat3d_core.zipnerf.render import Round, render_rays

TINY = dataclasses.replace(PRESETS["tiny"], iterations=60, warmup_iterations=5, batch_rays=256, lpips_weight=0.0)


def histogram(edges: list[float], weights: list[float]) -> Round:
    t = torch.tensor([edges], dtype=torch.float64)
    return Round(t, t, torch.tensor([weights], dtype=torch.float64))


def test_the_loss_is_the_distance_of_expected_inverse_depths() -> None:
    final = histogram([1.0, 3.0, 5.0], [0.5, 0.25])  # middles 2 and 4; a quarter of the light passes: inverse depth 0
    expected = 0.5 / 2 + 0.25 / 4
    for target in (0.0, 0.25, 1.0):
        loss = losses.inverse_depth(final, torch.tensor([target]).double(), torch.tensor([0.3]).double())
        assert float(loss) == pytest.approx(0.3 * ((expected - target) ** 2 + 1e-6) ** 0.5, rel=1e-6)


def test_its_gradient_is_that_of_the_closed_form_and_bounded_at_the_camera() -> None:
    final = histogram([0.0, 1e-9, 4.0], [0.2, 0.3])
    final.weights.requires_grad_()
    losses.inverse_depth(final, torch.zeros(1).double(), torch.ones(1).double()).backward()
    # Far from 0 the Charbonnier distance has slope 1: what is left is 1 / middle, at most 1 / NEAREST.
    assert final.weights.grad[0].tolist() == pytest.approx([100.0, 0.5], rel=1e-6)


def test_rays_without_a_known_depth_have_no_part_in_it() -> None:
    t = torch.tensor([[1.0, 3.0], [1.0, 3.0]], dtype=torch.float64)
    final = Round(t, t, torch.ones(2, 1, dtype=torch.float64))
    loss = losses.inverse_depth(final, torch.tensor([0.5, 123.0]).double(), torch.tensor([1.0, 0.0]).double())
    assert float(loss) == pytest.approx(0.5 * 1e-3)


def test_the_weight_falls_linearly_to_nothing() -> None:
    assert [losses.annealed(2.0, 0.5, p) for p in (0.0, 0.25, 0.5, 1.0)] == [2.0, 1.0, 0.0, 0.0]
    assert losses.annealed(2.0, 0.0, 0.0) == 0.0


def grey_views(depth: float | None) -> Views:
    """Three grey pictures side by side: their colours tell nothing of the depth."""
    poses = torch.eye(4).repeat(3, 1, 1)
    poses[:, 0, 3] = torch.tensor([-0.1, 0.0, 0.1])
    intrinsics = torch.tensor([[24.0, 0.0, 12.0], [0.0, 24.0, 10.0], [0.0, 0.0, 1.0]]).expand(3, 3, 3)
    images = [torch.full((20, 24, 3), 128, dtype=torch.uint8)] * 3
    depths = None if depth is None else [torch.full((20, 24), depth)] * 3
    cameras = Cameras(intrinsics, poses, torch.tensor([[24, 20]] * 3))
    return Views.from_images(cameras, images, torch.ones(3, dtype=torch.bool), depths=depths)


def trained(views: Views, **changes: float) -> Trainer:
    trainer = Trainer(dataclasses.replace(TINY, **changes), views, seed=0)
    while not trainer.finished:
        trainer.step()
    return trainer


def test_a_prior_puts_the_surface_where_colours_cannot_tell() -> None:
    found = {}
    for prior in (0.0, 1.0):
        trainer = trained(grey_views(2.0), depth_prior=prior)
        with torch.no_grad():
            final = render_rays(trainer.field, image_rays(trainer.views.cameras, 1)).rounds[-1]
        middle = 0.5 * (final.t[:, 1:] + final.t[:, :-1])
        found[prior] = float((final.weights / middle).sum(1).median())
    assert found[1.0] == pytest.approx(0.5, rel=0.1), found
    assert found[0.0] > 2.0, "without it the grey fog stands before the cameras"


def test_off_it_changes_nothing() -> None:
    plain, known = (trained(grey_views(depth), iterations=8, depth_prior=0.0) for depth in (None, 2.0))
    for (name, a), b in zip(plain.field.state_dict().items(), known.field.state_dict().values(), strict=True):
        assert torch.equal(a, b), name
