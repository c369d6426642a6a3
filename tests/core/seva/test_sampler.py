"""Noise levels, denoiser and trajectories of SEVA: the original's numbers, our own, and an explicit Euler loop."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from torch import nn

from cat3d_core.diffusion import GuidanceConfig, SamplerConfig
from cat3d_core.seva import sampler
from cat3d_core.seva.cameras import rays, scene_scale
from cat3d_core.seva.checkpoint import random_seva
from cat3d_core.seva.config import TINY
from cat3d_core.seva.guidance import ViewGuidance
from cat3d_core.seva.sampler import Windows, denoised, sample
from cat3d_core.seva.schedule import SevaSchedule
from tests.core.seva.models import EXPECTED, fixture_network, normalised_cameras, ring

FOUR_STEPS = SamplerConfig("ddim", "trailing", 4)
TOLERANCE = 1e-3  # relative (measured: 3e-6)


class Linear(nn.Module):
    """A network whose output is known: half of its input, and something of noise level and context."""

    def forward(self, latents, time, rays, mask, context):
        added = 0.001 * time[:, None] + context.mean(-1)
        return 0.5 * latents + added[..., None, None, None].to(latents)


def _close(got, expected):
    assert float((got - expected).norm() / expected.norm()) < TOLERANCE
    assert float((got - expected).abs().max() / expected.abs().max()) < TOLERANCE


@pytest.fixture(scope="module")
def original(shared_fixtures):
    numbers = load_file(shared_fixtures / "seva_sampling.safetensors")
    return fixture_network(shared_fixtures)[0], numbers


def _window(f, guidance: torch.Tensor) -> Windows:
    cameras = normalised_cameras(f["cam.c2w_scaled"], f["cam.K_normalised"])
    latents, mask = f["traj.replace"].split([4, 1], 1)
    given = mask[:, 0, 0, 0] > 0
    parts = latents, given, rays(cameras, 16, 24), f["traj.context"], guidance
    return Windows(*(part[None] for part in parts))


def test_noise_levels_are_exactly_the_originals(original):
    _, f = original
    schedule = SevaSchedule()
    assert torch.equal(torch.exp(-schedule.log_snr / 2).float(), f["sigmas.n1000_ascending"])
    for steps in (50, 20, 4, 1):
        nodes = schedule.nodes("trailing", steps)
        assert torch.equal(torch.exp(-nodes / 2).float(), f[f"sigmas.n{steps}_with_zero"][:-1])
    for steps in (50, 4):
        assert torch.equal(schedule.time(schedule.nodes("trailing", steps)).flip(0), f[f"timesteps.n{steps}_ascending"])
    assert torch.equal(schedule.time(-2 * f["idx.sigma"].double().log()), f["idx.index"])


def test_noise_levels_have_their_closed_form():
    schedule = SevaSchedule()
    betas = np.linspace(5e-6**0.5, 0.012**0.5, 1000) ** 2
    kept = np.cumprod(1 - betas)
    sigma = np.sqrt((1 - kept) / kept) * math.exp(2.4)
    np.testing.assert_allclose(torch.exp(-schedule.log_snr / 2).numpy(), sigma, rtol=1e-10)
    for steps in (1, 2, 3, 7, 50, 333, 1000):
        expected = [999 - (999 * k + steps - 1) // steps for k in range(steps)]
        assert schedule.time(schedule.nodes("trailing", steps)).tolist() == expected


@pytest.mark.parametrize("kind", ["trailing", "linspace", "log_snr", "karras"])
@pytest.mark.parametrize("steps", [1, 3, 10, 20])
def test_nodes_are_different_levels_of_the_table(kind, steps):
    schedule = SevaSchedule()
    nodes = schedule.nodes(kind, steps)
    index = schedule.time(nodes)
    assert torch.equal(schedule.log_snr[index], nodes)
    assert len(index) == steps
    assert (index.diff() < 0).all()


def test_too_many_steps_are_refused():
    for kind, steps in (("karras", 999), ("log_snr", 50), ("trailing", 1001), ("trailing", 0)):
        with pytest.raises(ValueError, match="different levels"):
            SevaSchedule().nodes(kind, steps)


def test_denoiser_agrees_with_the_original(original):
    network, f = original
    level = SevaSchedule().log_snr[SevaSchedule().time(-2 * f["den.sigma"][:1].double().log())]
    alpha = float(torch.sigmoid(level).sqrt())
    got = denoised(network, _window(f, torch.ones(5)), alpha * f["den.x"][None], float(level))
    # The original scales by the sigma it was asked for, the level of the table beside it.
    _close(got[0], f["den.denoised"])


@pytest.mark.parametrize(
    ("name", "guidance"),
    [
        ("traj.tiny_4steps_cfg2_multiview", ViewGuidance("multiview", 2.0)),
        ("traj.tiny_4steps_cfg3_temporal", ViewGuidance("temporal", 3.0)),
        ("traj.toy_4steps_cfg2", ViewGuidance("multiview", 2.0)),
    ],
)
def test_trajectories_agree_with_the_original(original, name, guidance):
    network, f = original
    cameras = normalised_cameras(f["cam.c2w_scaled"], f["cam.K_normalised"])
    given = torch.tensor([True, False, False, True, False])
    window = _window(f, guidance.scales(cameras, given))
    got = sample(Linear() if "toy" in name else network, window, f["traj.noise"][None], FOUR_STEPS)
    _close(got[0], f[name])


def own_windows(groups: int = 2, views: int = 4, seed: int = 0) -> tuple[Windows, torch.Tensor]:
    """Windows of the ring's cameras, the first view given, and noise."""
    g = torch.Generator().manual_seed(seed)
    cameras = ring(views)
    cameras = scene_scale(cameras).cameras(cameras)
    given = torch.arange(views) == 0
    windows = Windows(
        torch.randn(groups, views, 4, 8, 16, generator=g),
        given.expand(groups, -1),
        rays(cameras, 8, 16).float().expand(groups, -1, -1, -1, -1),
        torch.randn(groups, 1, 24, generator=g),
        ViewGuidance("multiview", 3.0).scales(cameras, given).expand(groups, -1),
    )
    return windows, torch.randn(groups, views, 4, 8, 16, generator=g)


def own_trajectories() -> dict[str, torch.Tensor]:
    network, (windows, noise) = random_seva(TINY, seed=1), own_windows()
    return {
        "sampler.ddim_trailing_4": sample(network, windows, noise, FOUR_STEPS),
        "sampler.unipc_log_snr_4": sample(network, windows, noise, SamplerConfig("unipc", "log_snr", 4)),
    }


def test_trajectories_are_what_they_were():
    expected = load_file(EXPECTED)
    for name, got in own_trajectories().items():
        _close(got, expected[name])


@pytest.mark.parametrize("steps", [1, 4, 50])
def test_sampler_is_eulers_method_in_sigma(steps):
    """x += (sigma' - sigma) (x - D) / sigma from x = noise * sqrt(1 + sigma^2), guided on D, in float64."""
    windows, noise = own_windows(groups=1)
    network = Linear()
    got = sample(network, windows, noise, SamplerConfig("ddim", "trailing", steps))

    given, s = windows.given[..., None, None, None], windows.guidance[..., None, None, None].double()
    schedule = SevaSchedule()
    nodes = schedule.nodes("trailing", steps)
    sigmas = [*torch.exp(-nodes / 2).tolist(), 0.0]
    x = noise.double() * (1 + sigmas[0] ** 2) ** 0.5
    for i in range(steps):
        sigma, time = sigmas[i], schedule.time(nodes[i])[None]

        def clean(x, context, sigma=sigma, time=time):
            found = network(x / (1 + sigma**2) ** 0.5, time, None, None, context)
            return x - sigma * found

        without = clean(x, 0 * windows.context)
        with_ = clean(torch.where(given, windows.latents.double(), x), windows.context)
        x = x + (sigmas[i + 1] - sigma) * (x - (without + s * (with_ - without))) / sigma
    torch.testing.assert_close(got.double(), x, rtol=1e-5, atol=1e-5 * float(x.abs().max()))


@pytest.mark.parametrize("solver", ["ddim", "dpm++", "unipc"])
def test_solvers_converge_to_the_exact_result(solver):
    """Of a smooth network's ODE: for data that is normal with deviation s the best epsilon is known."""

    class Gaussian(nn.Module):
        def forward(self, latents, time, rays, mask, context):
            ratio = torch.exp(-SevaSchedule().log_snr[time] / 2)[:, None, None, None, None]
            # E[noise | x] for x = alpha (clean + ratio noise), clean ~ N(0, 0.25)
            return (latents * (1 + ratio**2).sqrt() * ratio / (0.25 + ratio**2)).to(latents)

    windows, noise = own_windows(groups=1)
    windows = windows._replace(given=torch.zeros_like(windows.given), guidance=torch.ones_like(windows.guidance))
    errors = []
    for steps in (100, 200, 400):
        ends = SevaSchedule().nodes("trailing", steps)[[0, -1]]
        high, low = torch.exp(-ends / 2).tolist()
        # Along the exact path x / sqrt(0.25 + ratio^2) is constant; the last step takes the expected clean latent.
        start = noise.double() * (1 + high**2) ** 0.5
        exact = start * ((0.25 + low**2) / (0.25 + high**2)) ** 0.5 * 0.25 / (0.25 + low**2)
        got = sample(Gaussian(), windows, noise, SamplerConfig(solver, "trailing", steps)).double()
        errors.append(float((got - exact).abs().max() / exact.abs().max()))
    assert errors[2] < errors[1] < errors[0]
    assert errors[2] < (0.02 if solver == "ddim" else 0.002)


def test_views_have_their_own_guidance(monkeypatch):
    """A view guided by 1 gets the conditional prediction, whatever the others' scales."""
    windows, noise = own_windows()
    network = random_seva(TINY, seed=5)
    scales = windows.guidance.clone()
    scales[:, 2] = 1
    level = float(SevaSchedule().nodes("trailing", 4)[1])
    got = sampler.guided(network, windows._replace(guidance=scales), noise, level, FOUR_STEPS)
    alone = denoised(network, windows, noise, level)
    torch.testing.assert_close(got[:, 2], alone[:, 2], rtol=0, atol=1e-4 * float(alone.abs().max()))
    assert float((got[:, 1] - alone[:, 1]).abs().max()) > 1e-2 * float(alone.abs().max())
    calls = []
    monkeypatch.setattr(sampler, "denoised", lambda *a: calls.append(len(a[2])) or denoised(*a))
    outside = SamplerConfig("ddim", "trailing", 4, GuidanceConfig(low_log_snr=level + 1))
    assert torch.equal(sampler.guided(network, windows, noise, level, outside), alone)
    assert calls == [2]


def test_a_window_does_not_depend_on_the_others_of_its_call():
    windows, noise = own_windows(groups=3)
    network = random_seva(TINY, seed=6)
    one = SamplerConfig("ddim", "trailing", 2, micro_batch=1)
    together = sample(network, windows, noise, one)
    alone = sample(network, Windows(*(part[1:2] for part in windows)), noise[1:2], one)
    assert torch.equal(together[1:2], alone)
    pairs = sample(network, windows, noise, SamplerConfig("ddim", "trailing", 2, micro_batch=2))
    torch.testing.assert_close(pairs, together, rtol=1e-4, atol=1e-4 * float(together.abs().max()))


def test_shapes_that_do_not_fit_are_refused():
    windows, noise = own_windows()
    with pytest.raises(ValueError, match="needs latents of that shape"):
        sample(random_seva(TINY), windows, noise[:, :3], FOUR_STEPS)
