"""The sampler benchmark's closed-form network, and its front."""

from __future__ import annotations

import math

import pytest
import torch

from cat3d_core.diffusion import SIZES, Schedule
from cat3d_core.diffusion.schedule import alpha_sigma
from flows.bench.sampler import MixtureNetwork, front, table


@pytest.fixture(scope="module")
def network() -> MixtureNetwork:
    return MixtureNetwork(SIZES["tiny"], targets=2, shape=(2, 1, 1))


def test_log_snr_is_found_again_from_the_network_time(network):
    schedule = Schedule(SIZES["tiny"].schedule, 2)
    for log_snr in (*torch.linspace(-7.9, 5, 17).double(), schedule.log_snr[-2], schedule.log_snr[-2] - 3):
        step = float(schedule.time(log_snr))
        assert float(network._log_snr(step)) == pytest.approx(float(log_snr), abs=1e-6)
    assert network._log_snr(999.0) == -math.inf


@pytest.mark.parametrize("given", [True, False])
def test_prediction_is_the_posterior_mean(network, given):
    """E[clean | x] by importance sampling of the mixture (0.02 at 400,000 samples)."""
    g = torch.Generator().manual_seed(0)
    log_snr = torch.tensor(0.5, dtype=torch.float64)
    alpha, sigma = (float(s) for s in alpha_sigma(log_snr))
    time = Schedule(SIZES["tiny"].schedule, 2).time(log_snr)[None]
    x = torch.randn(1, 4, generator=g, dtype=torch.float64)
    latents = torch.cat([torch.zeros(1, 1, 2, 1, 1), x.reshape(1, 2, 2, 1, 1)], 1)
    mask = torch.tensor([[float(given), 0, 0]])
    v = network.double()(latents, time, torch.zeros(1, 3, 4, 4), mask)[:, 1:].flatten()
    modes = network.means[: 3 if given else 9]
    samples = modes[torch.randint(len(modes), (400_000,), generator=g)]
    samples = samples + network.std * torch.randn(samples.shape, generator=g, dtype=torch.float64)
    weight = (-(x - alpha * samples).square().sum(-1) / (2 * sigma**2)).softmax(0)
    clean = weight @ samples
    torch.testing.assert_close(v, (alpha * x[0] - clean) / sigma, rtol=0, atol=0.02)


def test_front_and_table():
    common = {"solver": "ddim", "nodes": "karras", "interval": "all", "dtype": "float32"}
    rows = [common | {"steps": n, "evaluations": n, "error": e} for n, e in ((10, 0.3), (20, 0.4), (30, 0.1))]
    assert [r["steps"] for r in front(rows)] == [10, 30]
    both = rows + [r | {"dtype": "bfloat16"} for r in rows]
    assert "| ddim | karras | all | 0.3000 (0.3000) | 0.4000 (0.4000) | 0.1000 (0.1000) |" in table(both)
