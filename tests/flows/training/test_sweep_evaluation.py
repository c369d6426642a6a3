"""The evaluation of sweep, sample and composite: what it measures, with and without a model that takes hints."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from cat3d_core.matching.composite import Composite
from cat3d_core.matching.network import SweepNetwork
from cat3d_core.synthetic.held_out import held_out_group
from flows.generation.formats import cat3d
from flows.training.sweep_composite import fitted
from flows.training.sweep_evaluation import Case, disagreement, hinted_sample, scores, swept
from tests.flows.stages.test_match import TINY
from tests.flows.workers.scene import random_model

SIZE, GIVEN = 64, 2


@pytest.fixture(scope="module")
def group() -> Case:
    traced, cameras = held_out_group("dtu", 0, SIZE, 5)
    pictures = {"sample": torch.full((3, 3, SIZE, SIZE), 0.5), "nearest": traced.image[:1].expand(3, -1, -1, -1)}
    return Case("dtu_0", ("dtu", "all"), GIVEN, traced.image, cameras, pictures, 1 / traced.depth[GIVEN:])


@pytest.fixture(scope="module")
def network() -> SweepNetwork:
    torch.manual_seed(0)
    return SweepNetwork(TINY).eval().requires_grad_(False)


def test_exact_pictures_agree_and_others_do_not(group: Case) -> None:
    truth, cameras = group.image[GIVEN:], group.cameras[slice(GIVEN, None)]
    assert group.inverse_depth is not None
    exact = disagreement(truth, group.inverse_depth, cameras)
    assert exact < 0.05
    assert disagreement(truth[[1, 2, 0]], group.inverse_depth, cameras) > 2 * exact
    assert disagreement(torch.full_like(truth, 0.3), group.inverse_depth, cameras) < 1e-6


def test_a_model_that_takes_hints_is_sampled_with_them(group: Case, network: SweepNetwork, tmp_path: Path) -> None:
    found = swept(network, group)
    plain = cat3d.load(random_model(tmp_path / "plain.safetensors"), "cpu", "float32")
    assert hinted_sample(plain, group, found) is group.pictures["sample"]
    hinted = cat3d.load(random_model(tmp_path / "hinted.safetensors", hints=True), "cpu", "float32")
    made = hinted_sample(hinted, group, found)
    assert made.shape == (3, 3, SIZE, SIZE)
    rows = scores(network, iter([group]), Composite(0.3, 0.1), None, None, hinted)
    composite = next(r for r in rows if r["label"] == "dtu" and r["method"] == "composite")
    expected = Composite(0.3, 0.1)(found.colour, found.confidence, made)
    error = (expected.clamp(0, 1) - group.image[GIVEN:]).square().mean((1, 2, 3))
    assert composite["psnr"] == pytest.approx(float(-10 * error.log10().mean()), abs=0.01)
    assert {"ssim", "disagreement"} <= set(composite)
    best, numbers = fitted(network, iter([group]), hinted)
    assert numbers["composite"] >= max(numbers["sweep"], numbers["sample"]) - 0.5
    assert 0 < best.middle < 1
