"""Settings of a field at the ends of their ranges, and what a fresh field is made of."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from cat3d_core.zipnerf.config import PRESETS
from cat3d_core.zipnerf.field import Field
from tests.core.zipnerf.test_training import TINY


def test_a_fresh_field_has_hes_variance() -> None:
    """Weights uniform within sqrt(6 / inputs), so of variance 2 / inputs; no bias; the tables within grid_init."""
    field = Field(PRESETS["fast"], seed=3)
    for module in field.modules():
        if isinstance(module, torch.nn.Linear):
            assert float(module.weight.detach().abs().max()) <= (6 / module.in_features) ** 0.5
            assert not module.bias.detach().any()
            if module.weight.numel() > 500:
                variance = float(module.weight.detach().double().var())
                assert variance == pytest.approx(2 / module.in_features, rel=0.2)
    for grid in field.grids:
        largest = float(grid.table.detach().abs().max())
        assert 0.9 * PRESETS["fast"].grid_init < largest <= PRESETS["fast"].grid_init


@pytest.mark.parametrize(
    "fits", [{"iterations": 1}, {"batch_rays": 1}, {"chunk_rays": 1}, {"samples": (2, 2)}, {"plateau_tolerance": 0.0}]
)
def test_the_least_settings_are_taken(fits: dict[str, object]) -> None:
    dataclasses.replace(TINY, **fits)


@pytest.mark.parametrize(
    "change",
    [
        {"iterations": 0}, {"batch_rays": 0}, {"chunk_rays": 0}, {"samples": (2, 1)}, {"patch_share": 1.1},
        {"captured_share": -0.1}, {"depth_prior": -1.0}, {"depth_prior_until": 1.1}, {"lr_final": 0.0},
        {"lr_final": 1.0, "lr_init": 0.5}, {"proposal_every": 0}, {"lpips_every": 0}, {"plateau_every": 0},
        {"skip_groups": 0}, {"skip_transmittance": 1.0}, {"plateau_tolerance": 1.0}, {"plateau_cooldown": 1.1},
        {"plateau_from": -0.1}, {"samples": (16,)}, {"interlevel_blur": ()},
    ],
)  # fmt: skip
def test_settings_outside_their_range_are_refused(change: dict[str, object]) -> None:
    with pytest.raises(ValueError, match="at least|lie|falls|entry"):
        dataclasses.replace(TINY, **change)
