"""The held-out evaluation: its baselines are what they say, and an untrained model runs through it."""

import torch

from cat3d_core.diffusion import SIZES, GuidanceConfig, MultiViewModel, SamplerConfig
from cat3d_core.generation import Cat3dGenerator
from cat3d_core.synthetic import FAMILIES
from flows.training.evaluation import ALL_CAPTURED, captured_group, rows, table


def test_rows_of_an_untrained_model():
    torch.manual_seed(0)
    model = MultiViewModel(SIZES["tiny"]).eval()
    sampler = SamplerConfig(steps=4, guidance=GuidanceConfig(scale=1.0))
    result = rows(Cat3dGenerator(model), scenes_per_family=1, conditions=(3,), sampler=sampler)
    assert len(result) == 4 * (len(FAMILIES) + 1)
    assert {r["scenes"] for r in result if r["family"] == "all"} == {len(FAMILIES)}
    assert "| 3 | all |" in table(result)


def test_captured_scenes_are_scored_beside_the_procedural_ones(shared_data):
    """Training views of the split first; the cameras see the same points as in the full photographs."""
    images, cameras = captured_group(shared_data / "llff_fern", 64, 3)
    assert images.shape == (3 + 3, 3, 64, 64)  # fern has three test views
    assert (cameras.size == 64).all()
    # The scene is normalised: the axes' common point, at mean distance about 1, lies in the middle of each square.
    pixels, depth = cameras.project(torch.zeros(1, 3, dtype=torch.float64))
    assert (depth > 0.3).all()
    assert (pixels - 32).abs().max() < 24
    model = MultiViewModel(SIZES["tiny"]).eval()
    sampler = SamplerConfig(steps=1, guidance=GuidanceConfig(scale=1.0))
    result = rows(Cat3dGenerator(model), 0, (3,), sampler, captured=[shared_data / "llff_fern"])
    assert {r["family"] for r in result} == {"llff_fern", ALL_CAPTURED}
    assert {r["method"] for r in result} == {"sample", "nearest", "autoencoder"}
    assert f"| 3 | {ALL_CAPTURED} |" in table(result)
