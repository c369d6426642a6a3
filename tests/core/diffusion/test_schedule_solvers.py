"""Noise levels and ODE solvers, against closed forms and diffusers' schedulers."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from cat3d_core.diffusion import Schedule, ScheduleConfig
from cat3d_core.diffusion.schedule import alpha_sigma
from cat3d_core.diffusion.solvers import integrate

SD = ScheduleConfig(zero_terminal_snr=False, prediction="eps")


@pytest.mark.parametrize("base", ["scaled_linear", "linear", "cosine"])
@pytest.mark.parametrize("targets", [1, 5, 7])
def test_log_snr_is_shifted_by_log_n_exactly(base, targets):
    for zero_terminal in (False, True):
        config = ScheduleConfig(base=base, zero_terminal_snr=zero_terminal)
        shifted, plain = Schedule(config, targets).log_snr, Schedule(config, 1).log_snr
        finite = torch.isfinite(plain)
        assert finite[:-1].all()
        assert bool(finite[-1]) != zero_terminal
        assert (shifted - plain + math.log(targets))[finite].abs().max() < 1e-12
        assert (shifted.diff() < 0).all()


def test_stable_diffusion_table_agrees_with_diffusers():
    from diffusers import DDIMScheduler

    for zero_terminal in (False, True):
        oracle = DDIMScheduler(
            beta_start=0.00085, beta_end=0.012, beta_schedule="scaled_linear", rescale_betas_zero_snr=zero_terminal
        )
        config = ScheduleConfig(zero_terminal_snr=zero_terminal)
        ours = alpha_sigma(Schedule(config, 1).log_snr)[0] ** 2
        torch.testing.assert_close(ours, oracle.alphas_cumprod.double(), rtol=0, atol=2e-6)  # theirs is float32
    assert Schedule(config, 7).log_snr[-1] == -math.inf


def test_eps_prediction_with_zero_terminal_snr_is_refused():
    with pytest.raises(ValueError, match="zero terminal SNR"):
        ScheduleConfig(prediction="eps", zero_terminal_snr=True)


@given(
    st.sampled_from(["noise", "index"]), st.booleans(), st.sampled_from(["scaled_linear", "cosine"]), st.integers(1, 7)
)
def test_network_time_inverts_the_table(time_input, zero_terminal, base, targets):
    schedule = Schedule(ScheduleConfig(base=base, zero_terminal_snr=zero_terminal, time_input=time_input), targets)
    table = schedule.log_snr if time_input == "index" else schedule.base_log_snr
    index = torch.arange(1000, dtype=torch.float64)
    torch.testing.assert_close(schedule.time(table), index, rtol=0, atol=1e-8)
    between = (table[:-2] + table[1:-1]) / 2
    torch.testing.assert_close(schedule.time(between), index[:-2] + 0.5, rtol=0, atol=1e-8)


@pytest.mark.parametrize("kind", ["trailing", "linspace", "log_snr", "karras"])
@pytest.mark.parametrize("zero_terminal", [False, True])
def test_nodes_go_from_noise_to_clean(kind, zero_terminal):
    schedule = Schedule(ScheduleConfig(zero_terminal_snr=zero_terminal), 7)
    for steps in (3, 7, 50):
        nodes = schedule.nodes(kind, steps)
        assert len(nodes) == steps
        assert (nodes.diff() > 0).all()
        torch.testing.assert_close(nodes[0], schedule.log_snr[-1], rtol=1e-12, atol=0)
        if kind != "trailing":
            assert abs(float(nodes[-1] - schedule.log_snr[0])) < 1e-9


def test_nodes_are_those_of_diffusers():
    from diffusers import DDIMScheduler

    for kind in ("trailing", "linspace"):
        oracle = DDIMScheduler(beta_start=0.00085, beta_end=0.012, beta_schedule="scaled_linear", timestep_spacing=kind)
        for steps in (10, 15, 50):
            oracle.set_timesteps(steps)
            schedule = Schedule(SD, 1)
            assert torch.equal(schedule.nodes(kind, steps), schedule.log_snr[oracle.timesteps])


class Mixture:
    """Two Gaussians on a line: the exact clean-latent estimate of the diffused density, in closed form."""

    means = torch.tensor([-1.0, 1.5], dtype=torch.float64)
    weights = torch.tensor([0.4, 0.6], dtype=torch.float64)
    std = 0.5

    def clean(self, x: torch.Tensor, log_snr: float) -> torch.Tensor:
        alpha, sigma = (float(s) for s in alpha_sigma(torch.tensor(log_snr, dtype=torch.float64)))
        variance = alpha**2 * self.std**2 + sigma**2
        logits = self.weights.log() - (x[..., None] - alpha * self.means) ** 2 / (2 * variance)
        gain = alpha * self.std**2 / variance
        posterior = self.means + gain * (x[..., None] - alpha * self.means)
        return (logits.softmax(-1) * posterior).sum(-1)


@pytest.mark.parametrize(("solver", "order"), [("ddim", 1), ("dpm++", 2), ("unipc", 3)])
def test_solvers_converge_at_their_order(solver, order):
    """Global error of an order-p method falls as n^-p. UniPC-2 with its corrector is of order 3."""
    mixture, start = Mixture(), torch.linspace(-2, 2, 33, dtype=torch.float64)

    def run(steps: int, name: str = solver) -> torch.Tensor:
        nodes = torch.linspace(-6, 4, steps + 1, dtype=torch.float64)
        return integrate(start, nodes, lambda x, i: mixture.clean(x, float(nodes[i])), name)

    truth = run(4000, "unipc")
    counts = [40, 80, 160]
    errors = [float((run(n) - truth).abs().max()) for n in counts]
    slope = -np.polyfit(np.log(counts), np.log(errors), 1)[0]
    assert slope > order - 0.25, (slope, errors)
    assert slope < order + 0.8


@settings(max_examples=10)
@given(st.floats(-3, 3), st.floats(0.1, 2.0))
def test_one_gaussian_is_mapped_by_its_exact_flow(mean, std):
    """For N(mean, std^2) the flow keeps standard scores: the solution is known in closed form (1e-6 at 2,000 DPM++
    steps)."""
    mixture = Mixture()
    mixture.means, mixture.weights, mixture.std = torch.tensor([mean]).double(), torch.ones(1).double(), std
    nodes = torch.linspace(-8, 6, 2001, dtype=torch.float64)
    (a0, a1), (s0, s1) = (t.tolist() for t in (p[[0, -1]] for p in alpha_sigma(nodes)))
    x = torch.tensor([-1.0, 0.2, 2.0], dtype=torch.float64)
    score = (x - a0 * mean) / math.hypot(a0 * std, s0)
    got = integrate(x, nodes, lambda x, i: mixture.clean(x, float(nodes[i])), "dpm++")
    torch.testing.assert_close(got, a1 * mean + math.hypot(a1 * std, s1) * score, rtol=0, atol=1e-5)


def _fake_network(x: torch.Tensor, t: int) -> torch.Tensor:
    return torch.tanh(x * 0.7 + 0.3) * (0.5 + t / 2000)


@pytest.mark.parametrize("solver", ["ddim", "dpm++", "unipc"])
@pytest.mark.parametrize("prediction", ["eps", "v"])
def test_solvers_agree_with_diffusers_on_the_same_nodes(solver, prediction):
    from diffusers import DDIMScheduler, DPMSolverMultistepScheduler, UniPCMultistepScheduler

    common = {
        "beta_start": 0.00085,
        "beta_end": 0.012,
        "beta_schedule": "scaled_linear",
        "timestep_spacing": "trailing",
        "prediction_type": "epsilon" if prediction == "eps" else "v_prediction",
    }
    if solver == "ddim":
        # Steps that divide 1000: elsewhere diffusers' DDIM steps to t - T//n, which is not its own next node.
        oracle = DDIMScheduler(**common, set_alpha_to_one=True, clip_sample=False)
    elif solver == "dpm++":
        oracle = DPMSolverMultistepScheduler(**common, final_sigmas_type="zero")
    else:
        oracle = UniPCMultistepScheduler(**common, solver_order=2, solver_type="bh2", final_sigmas_type="zero")
    steps = 20
    oracle.set_timesteps(steps)
    schedule = Schedule(ScheduleConfig(zero_terminal_snr=False, prediction=prediction), 1)
    nodes = schedule.nodes("trailing", steps)
    x = theirs = torch.randn(4, 3, 8, 8, generator=torch.Generator().manual_seed(0))
    for t in oracle.timesteps:
        theirs = oracle.step(_fake_network(theirs, int(t)), t, theirs).prev_sample

    def clean(x: torch.Tensor, i: int) -> torch.Tensor:
        return schedule.clean(x, _fake_network(x, int(oracle.timesteps[i])), nodes[i])

    ours = integrate(x, torch.cat([nodes, torch.tensor([math.inf])]), clean, solver)
    # float32 states and, at their side, float32 coefficients.
    torch.testing.assert_close(ours, theirs, rtol=2e-4, atol=2e-4)


@pytest.mark.parametrize("solver", ["ddim", "dpm++", "unipc"])
def test_start_from_pure_noise_and_end_clean_are_finite(solver):
    schedule = Schedule(ScheduleConfig(), 7)
    for kind in ("trailing", "linspace", "log_snr", "karras"):
        nodes = torch.cat([schedule.nodes(kind, 8), torch.tensor([math.inf])])
        levels = iter(nodes.tolist())
        got = integrate(
            torch.linspace(-2, 2, 9).double(), nodes, lambda x, _, at=levels: Mixture().clean(x, next(at)), solver
        )
        assert torch.isfinite(got).all()
        assert (got.diff() > 0).all()
