"""Settings of a field at the ends of their ranges, and what a fresh field is made of."""

from __future__ import annotations

import dataclasses
import json

import pytest
import torch

from cat3d_core.reconstruction import ReconstructionRequest
from cat3d_core.zipnerf.config import PRESETS
from cat3d_core.zipnerf.field import Field
from cat3d_core.zipnerf.reconstructor import PASSED, ZipNerf
from cat3d_core.zipnerf.settings import (
    PASSES,
    STRONG_LPIPS,
    chosen_config,
    config_document,
    config_from_document,
    enough_rays,
)  # fmt: skip
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


@pytest.mark.parametrize("preset", PRESETS)
def test_settings_survive_json(preset: str) -> None:
    assert config_from_document(json.loads(json.dumps(config_document(PRESETS[preset])))) == PRESETS[preset]
    with pytest.raises(ValueError, match="unknown"):
        config_from_document({"unknown": 1})


def test_a_request_chooses_the_perceptual_weight_and_what_is_skipped() -> None:
    fast, every = PRESETS["fast"], {"low_resolution": True, "proposals": True, "lpips": True, "empty_space": True}
    plain = chosen_config(ReconstructionRequest("fast", skip=every))
    assert plain.lpips_weight == 0, "captured views alone: no perceptual loss"
    assert plain.low_resolution_iterations == 0, "which saves on patches, and there are none"
    assert (plain.proposal_every, plain.lpips_every, plain.skip_transmittance) == (4, 2, 0.01)
    made = chosen_config(ReconstructionRequest("fast", generated=True, skip=every))
    assert (made.lpips_weight, made.low_resolution_iterations) == (fast.lpips_weight, fast.iterations // 8)
    strong = chosen_config(ReconstructionRequest("fast", {"samples": [8, 8]}, "co3d", True))
    assert strong.lpips_weight == STRONG_LPIPS * fast.lpips_weight
    assert strong.samples == (8, 8)
    assert (strong.proposal_every, strong.skip_transmittance, strong.low_resolution_iterations) == (1, 0.0, 0)
    for request in (ReconstructionRequest("none"), ReconstructionRequest("fast", {"none": 1})):
        with pytest.raises(ValueError, match="none"):
            chosen_config(request)


def test_rays_are_enough_where_a_few_passes_see_all_pixels() -> None:
    config = dataclasses.replace(PRESETS["fast"], batch_rays=1000)
    assert enough_rays(config, 1000 * PASSES, False)[0] == 1000
    assert enough_rays(config, 999 * PASSES, False)[0] == 999
    assert enough_rays(config, 10, False)[0] == 256
    assert enough_rays(dataclasses.replace(config, iterations=10), 1000 * PASSES, True)[0] == 1000


def test_a_training_fills_so_many_pixels_of_a_view() -> None:
    made = ZipNerf.from_request(ReconstructionRequest("tiny", {"iterations": 3, "batch_rays": 100}))
    assert made.view_pixels == 300 // PASSED == 37
    assert isinstance(made.view_pixels, int)
    assert made.settings["perceptual"] is None
