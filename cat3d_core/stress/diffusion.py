"""Schedules, solver steps, guidance."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from cat3d_core.diffusion.conditioning import Condition, make_condition
from cat3d_core.diffusion.config import Prediction, ScheduleConfig
from cat3d_core.diffusion.guidance import GuidanceConfig, guided
from cat3d_core.diffusion.schedule import Schedule, alpha_sigma
from cat3d_core.diffusion.solvers import SOLVERS, integrate
from cat3d_core.stress.draw import Draw
from cat3d_core.stress.routine import DOUBLE, ROUNDING, SINGLE, Call, Exact, Reference, Routine, each, zero


def _snr_inputs(draw: Draw) -> tuple[Tensor, ...]:
    wild = draw.signed(1)[:, 0]
    usual = draw.between(1, -150, 150)[:, 0]
    kind = draw.unit(1)[:, 0]
    infinite = torch.where(kind > 0.98, torch.inf, -torch.inf)
    return (torch.where(kind < 0.5, usual, torch.where(kind < 0.96, wild, infinite)),)


def _amplitudes_reference(log_snr: Tensor) -> Exact:
    """alpha = exp(l/2) / sqrt(1 + exp(l)) = exp(-log(1 + exp(-l)) / 2)."""
    alpha, sigma = (torch.exp(-torch.logaddexp(torch.zeros_like(x), x) / 2) for x in (-log_snr, log_snr))
    value = torch.stack([alpha, sigma], -1)
    # float32's exp ends at 88; an amplitude below 1e-19 may become 0.
    return Exact(value, value + 1e-14)


_SCHEDULES = {
    "cosine": Schedule(ScheduleConfig(base="cosine"), 5),
    "scaled_linear": Schedule(ScheduleConfig(base="scaled_linear"), 5),
    "linear": Schedule(ScheduleConfig(base="linear", zero_terminal_snr=False), 5),
}


def _time(schedule: Schedule) -> Call:
    """Distance in log-SNR between what was asked and the table's curve at the answer, or past its ends."""
    table = schedule.base_log_snr

    def call(log_snr: Tensor) -> Tensor:
        index = schedule.time(log_snr)
        if not len(index):
            return index
        last = len(table) - 1
        low = index.floor().long().clamp(0, last - 1)
        share = index - low
        ends = table[low], table[low + 1]
        alpha = [alpha_sigma(end)[0] for end in ends]
        mixed = (1 - share) * alpha[0] + share * alpha[1]
        by_alpha = 2 * torch.log(mixed) - torch.log1p(-(mixed.square()))
        curve = torch.where(torch.isinf(ends[1]), by_alpha, (1 - share) * ends[0] + share * ends[1])
        curve = torch.where(share == 0, ends[0], torch.where(share == 1, ends[1], curve))
        wanted = log_snr.clamp(table[-1], table[0])
        off = (curve - wanted).abs() / (1 + wanted.abs())
        # Beyond a last finite entry the curve ends at pure noise, where alpha is what counts.
        amplitude = (torch.exp(curve / 2) - torch.exp(wanted / 2)).abs()
        return torch.where(torch.isfinite(table[-1]) | (wanted > -8), off, amplitude).nan_to_num(torch.inf, torch.inf)

    return call


def _clean_inputs(draw: Draw) -> tuple[Tensor, ...]:
    return draw.signed(4), draw.signed(4), draw.between(1, -20, 20)


def _clean(kind: Prediction) -> Call:
    schedule = Schedule(ScheduleConfig(prediction=kind, zero_terminal_snr=False), 1)
    return each(lambda x, prediction, log_snr: schedule.clean(x, prediction, log_snr[0]))


def _clean_reference(kind: Prediction) -> Reference:
    def exact(x: Tensor, prediction: Tensor, log_snr: Tensor) -> Exact:
        alpha, sigma = (1 / (1 + torch.exp(-log_snr))).sqrt(), (1 / (1 + torch.exp(log_snr))).sqrt()
        if kind == "v":
            return Exact(alpha * x - sigma * prediction, alpha * x.abs() + sigma * prediction.abs())
        return Exact(x / alpha - prediction * torch.exp(-log_snr / 2),
                     x.abs() / alpha + prediction.abs() * torch.exp(-log_snr / 2))  # fmt: skip

    return exact


_STEPS = 5


def _solver_inputs(draw: Draw) -> tuple[Tensor, ...]:
    """First log-SNR and the steps from it, a start, and predictions of the clean latent: constant, or anything."""
    steps = draw.log_between(_STEPS, 1e-6, 8.0)
    steps = torch.where(draw.unit(1) < 0.5, steps, steps[:, :1] * draw.between(_STEPS, 0.5, 2.0))
    first = torch.where(draw.unit(1) < 0.3, -torch.inf, draw.between(1, -20, 0))
    # From pure noise and to the clean latent, as the sampler goes, in some cases.
    steps = torch.cat([steps[:, :-1], torch.where(draw.unit(1) < 0.3, torch.inf, steps[:, -1:])], 1)
    clean = draw.normal(_STEPS * 2).view(-1, _STEPS, 2)
    clean = torch.where((draw.unit(1) < 0.4)[..., None], clean[:, :1], clean)
    size = draw.log_between(1, 1e-12, 1e12)
    return first, steps, draw.normal(2) * size, clean * size[..., None]


def _nodes(first: Tensor, steps: Tensor) -> Tensor:
    """[n + 1] float64, whatever the state's dtype; after pure noise they go on from -20."""
    start = first.double().clamp_min(-20.0)
    return torch.cat([first.double(), start + steps.double().cumsum(0)])


def _solver(name: str) -> Call:
    def one(first: Tensor, steps: Tensor, x: Tensor, clean: Tensor) -> Tensor:
        return integrate(x, _nodes(first, steps), lambda _, i: clean[i], name)

    return each(one)


# Gauss-Legendre points and weights on [0, 1], by Newton's method on the Legendre polynomial.
def _gauss(count: int) -> tuple[list[float], list[float]]:
    points, weights = [], []
    for i in range(count):
        x = math.cos(math.pi * (i + 0.75) / (count + 0.5))
        for _ in range(100):
            before, value = 1.0, x
            for k in range(2, count + 1):
                before, value = value, ((2 * k - 1) * x * value - (k - 1) * before) / k
            slope = count * (x * value - before) / (x * x - 1)
            x -= value / slope
        points.append((x + 1) / 2)
        weights.append(1 / ((1 - x * x) * slope * slope))
    return points, weights


_GAUSS = _gauss(24)


def _weighted(h: float, power: int, alpha: float) -> float:
    """alpha_t times the integral of exp(l - l_t) ((l - l_s) / h)^power over a step of length h in half log-SNR."""
    if power == 0:
        return alpha * -math.expm1(-h)
    return alpha * h * sum(w * math.exp(h * (p - 1)) * p**power for p, w in zip(*_GAUSS, strict=True))


def _solver_reference(name: str) -> Reference:
    """The steps by quadrature: the clean latent between nodes is the polynomial that each method's paper says."""

    def one(first: Tensor, steps: Tensor, x: Tensor, clean: Tensor) -> tuple[Tensor, Tensor]:
        nodes = _nodes(first, steps)
        alpha, sigma = (1 / (1 + torch.exp(-nodes))).sqrt().tolist(), (1 / (1 + torch.exp(nodes))).sqrt().tolist()
        half = (nodes / 2).tolist()
        start, scale = x, x.abs() + clean.abs().amax()

        def step(i: int, x: Tensor) -> Tensor:
            return sigma[i + 1] / sigma[i] * x + _weighted(half[i + 1] - half[i], 0, alpha[i + 1]) * clean[i]

        for i in range(_STEPS):
            h = half[i + 1] - half[i]
            last = half[i] - half[i - 1] if i else math.inf
            if name == "unipc" and i and math.isfinite(last):
                longer = half[i - 1] - half[i - 2] if i > 1 else math.inf
                x = step(i - 1, start)
                if math.isfinite(longer):
                    # The parabola through the last three predictions, in u = (l - l_s) / h.
                    r = -longer / last
                    rise, back = clean[i] - clean[i - 1], clean[i - 2] - clean[i - 1]
                    square = (back - r * rise) / (r * (r - 1))
                    slope = rise - square
                    x = x + _weighted(last, 1, alpha[i]) * slope + _weighted(last, 2, alpha[i]) * square
                    scale = scale + clean.abs().amax() * (1 + 1 / abs(r * (r - 1)))
                else:
                    x = x + 0.5 * _weighted(last, 0, alpha[i]) * (clean[i] - clean[i - 1])
            start = x
            x = step(i, x)
            if name != "ddim" and i and math.isfinite(h) and math.isfinite(last):
                x = x + 0.5 * _weighted(h, 0, alpha[i + 1]) * (clean[i] - clean[i - 1]) * (h / last)
                scale = scale + clean.abs().amax() * (h / last)
        return x, scale

    def exact(first: Tensor, steps: Tensor, x: Tensor, clean: Tensor) -> Exact:
        rows = [one(*row) for row in zip(first, steps, x, clean, strict=True)]
        if not rows:
            return Exact(x, x)
        value, scale = (torch.stack(part) for part in zip(*rows, strict=True))
        return Exact(value, scale)

    return exact


def _guidance_inputs(draw: Draw) -> tuple[Tensor, ...]:
    return draw.signed(4), draw.signed(4), draw.choice(0.0, 1.0, 3.0, 30.0)


def _guided(conditional: Tensor, unconditional: Tensor, scale: Tensor) -> Tensor:
    """Both predictions come from the mask of the condition, as the network's would."""
    condition = make_condition(conditional.new_ones(1, 1, 1, 1, 1), conditional.new_ones(1, 2, 6, 1, 1))

    def predict(given: Condition, x: Tensor) -> Tensor:
        kept = given.mask[:, 0] > 0
        both = torch.where(kept[:, None], conditional, unconditional)
        return both[:, None, :, None, None].expand_as(x)

    x = conditional.new_zeros(1, 1, 4, 1, 1)
    return guided(predict, condition, x, 0.0, GuidanceConfig(scale=float(scale)))[0, 0, :, 0, 0]


def _guided_reference(conditional: Tensor, unconditional: Tensor, scale: Tensor) -> Exact:
    value = scale * conditional + (1 - scale) * unconditional
    size = scale * conditional.abs() + (1 + scale) * unconditional.abs()
    return Exact(value, torch.where(scale == 1, conditional.abs(), size))  # at 1 nothing may be added and taken away


# UniPC's weights divide what cancels by the step: some 1e-16 / 1e-6 for the shortest step here.
_SOLVER_BOUNDS = {"ddim": ROUNDING, "dpm++": ROUNDING, "unipc": {DOUBLE: 1e-10, SINGLE: 2e-6}}

ROUTINES = [
    Routine(
        "schedule.alpha_sigma", "amplitudes at any log-SNR, exact at both infinities",
        _snr_inputs, lambda x: torch.stack(alpha_sigma(x), -1), _amplitudes_reference, {DOUBLE: 1e-14, SINGLE: 1e-5},
    ),
    *[
        Routine(
            f"schedule.time[{name}]", "the step that has this log-SNR, on and between entries, clamped at the ends",
            _snr_inputs, _time(schedule), zero, {DOUBLE: 4e-14},
        )
        for name, schedule in _SCHEDULES.items()
    ],
    *[
        Routine(
            f"schedule.clean[{kind}]", "the clean latent from a prediction", _clean_inputs, _clean(kind),
            _clean_reference(kind), ROUNDING, share=0.1, floor=1e-25,
        )
        for kind in ("v", "eps")
    ],
    *[
        Routine(
            f"solvers.{name}", "five steps of 1e-6 to 8 in log-SNR, from pure noise and to the clean latent too",
            _solver_inputs, _solver(name), _solver_reference(name), _SOLVER_BOUNDS[name], share=0.02,
        )
        for name in SOLVERS if name in _SOLVER_BOUNDS
    ],
    Routine(
        "guidance.guided", "scales 0, 1, 3 and 30; scale 1 changes nothing",
        _guidance_inputs, each(_guided), _guided_reference, ROUNDING, share=0.05,
    ),
]  # fmt: skip
