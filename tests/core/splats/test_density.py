"""MCMC's moves: a Gaussian and its copies look alike, the dead live on elsewhere, noise stirs what hardly shows."""

from __future__ import annotations

import math

import pytest
import torch

from cat3d_core.splats.density import noise, relocate, split
from cat3d_core.splats.gaussians import Gaussians
from tests.core.splats.scenes import gaussians

WIDE = torch.float64


@pytest.mark.parametrize("copies", [1, 2, 5, 20])
@pytest.mark.parametrize("opacity", [0.01, 0.3, 0.9, 0.999])
def test_split_is_the_papers_double_sum(copies: int, opacity: float) -> None:
    """Kheradmand et al. 2024, eq. 9, with binomials as whole numbers and mpmath's fractions of 50 digits."""
    from mpmath import mp, mpf

    with mp.workdps(50):
        new = 1 - (1 - mpf(opacity)) ** (mpf(1) / copies)
        total = sum(
            math.comb(i - 1, k) * (-1) ** k * new ** (k + 1) / mp.sqrt(k + 1)
            for i in range(1, copies + 1)
            for k in range(i)
        )
        wanted = [float(new), float(mpf(opacity) / total)]
    for dtype, tolerance in ((torch.float64, 1e-12), (torch.float32, 2e-6)):
        got = split(torch.tensor([opacity], dtype=dtype), torch.tensor([copies]))
        assert [float(part) for part in got] == pytest.approx(wanted, rel=tolerance)


def test_the_dead_take_the_place_of_the_living() -> None:
    g = gaussians(50).to(dtype=torch.float32)
    logits = g.logits.clone()
    logits[::5] = -12.0
    g = Gaussians(g.means, g.quaternions, g.log_scales, logits, g.harmonics)
    move = relocate(g, 7, 0.005, torch.Generator().manual_seed(0))
    assert move.dead == 10
    assert len(move.gaussians) == 57
    assert bool((move.gaussians.opacities > 0.005).all())
    places = {tuple(mean) for mean in g.means[logits > -5].tolist()}
    assert {tuple(mean) for mean in move.gaussians.means.tolist()} <= places
    changed = torch.zeros(57, dtype=torch.bool)
    changed[move.changed] = True
    kept = (~changed).nonzero()[:, 0]
    for name, value in move.gaussians.tensors().items():
        assert torch.equal(value[kept], g.tensors()[name][kept])
    assert set(range(0, 50, 5)) | set(range(50, 57)) <= set(move.changed.tolist())


def test_without_dead_or_living_nothing_moves() -> None:
    g = gaussians(9).to(dtype=torch.float32)
    assert relocate(g, 0, 1e-9, torch.Generator().manual_seed(0)).gaussians is g
    assert relocate(g, 3, 0.9999999, torch.Generator().manual_seed(0)).gaussians is g


def test_noise_stirs_only_what_hardly_shows_along_its_own_axes() -> None:
    g = gaussians(4000).to(dtype=torch.float32)
    flat = torch.tensor([0.0, -1.0, -9.0]).expand(4000, 3)
    logits = torch.where(torch.arange(4000) < 2000, -12.0, 3.0)
    quaternions = torch.tensor([1.0, 0, 0, 0]).expand(4000, 4)
    g = Gaussians(g.means, quaternions, flat, logits, g.harmonics)
    step = noise(g, 0.5, torch.Generator().manual_seed(0))
    assert float(step[2000:].abs().max()) < 1e-6
    gate = 1 / (1 + math.exp(-0.5))
    expected = [0.5 * gate, 0.5 * gate * math.exp(-1), 0.5 * gate * math.exp(-9)]
    assert step[:2000].std(0).tolist() == pytest.approx(expected, rel=0.05)


def test_copies_of_what_does_not_show_keep_its_size() -> None:
    opacity, factor = split(torch.zeros(3), torch.tensor([1, 2, 20]))
    assert torch.equal(opacity, torch.zeros(3))
    assert torch.equal(factor, torch.ones(3))
