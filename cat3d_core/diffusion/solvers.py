"""Solvers of the probability-flow ODE, as multistep exponential integrators on predictions of the clean latent.

In the half log-SNR l = log(alpha / sigma) the ODE is d(x / sigma)/dl = exp(l) clean(x, l), so from l_s to l_t, h = l_t
- l_s, x_t = sigma_t/sigma_s x_s + alpha_t (1 - exp(-h)) clean + corrections from how `clean` changed over the last
steps. DDIM is the first order (Song et al. 2021); DPM-Solver++(2M) the second order multistep (Lu et al. 2022); UniPC
adds a corrector that costs no evaluation (Zhao et al. 2023, B(h) = exp(h) - 1). Steps from pure noise (h = inf) and to
the clean latent (h = inf) are first order. Coefficients are float64 scalars, the state keeps its own dtype.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Literal

import torch
from torch import Tensor

from cat3d_core.diffusion.schedule import alpha_sigma

SolverName = Literal["ddim", "dpm++", "unipc"]


class Solver:
    """Walks along log-SNR nodes [n+1] float64 (increasing; the ends may be infinite). Holds the predictions of the last
    two nodes, nothing else."""

    def __init__(self, name: SolverName, log_snr: Tensor) -> None:
        if name not in ("ddim", "dpm++", "unipc"):
            raise ValueError(f"Unknown solver {name!r}: use ddim, dpm++ or unipc.")
        self.name = name
        alpha, sigma = alpha_sigma(log_snr.double())
        self.alpha, self.sigma = alpha.tolist(), sigma.tolist()
        self.half = (log_snr.double() / 2).tolist()
        self.previous: Tensor | None = None  # prediction at the node before the current one
        self.start: Tensor | None = None  # state from which the last step was made
        self.earlier: Tensor | None = None  # prediction two nodes back

    def step(self, i: int, x: Tensor, clean: Tensor) -> Tensor:
        """From node i to node i + 1, given the prediction `clean` at node i."""
        if self.name == "unipc" and i > 0 and math.isfinite(self._h(i - 1)):
            x = self._correct(i - 1, clean)
        second_order = self.name != "ddim" and i > 0 and math.isfinite(self._h(i)) and math.isfinite(self._h(i - 1))
        correction = self._slope(i, clean) if second_order else None
        result = self._first_order(i, x, clean)
        if correction is not None:
            # (1 - exp(-h)) / 2 times the change of `clean` over a step of this length, by the last difference.
            result = result + (0.5 * self.alpha[i + 1] * -math.expm1(-self._h(i))) * correction
        self.earlier, self.previous, self.start = self.previous, clean, x
        return result

    def _h(self, i: int) -> float:
        return self.half[i + 1] - self.half[i]

    def _first_order(self, i: int, x: Tensor, clean: Tensor) -> Tensor:
        gain = self.sigma[i + 1] / self.sigma[i]
        return gain * x + (-self.alpha[i + 1] * math.expm1(-self._h(i))) * clean

    def _slope(self, i: int, clean: Tensor) -> Tensor:
        """Expected change of the prediction over step i, extrapolated from the last two predictions."""
        assert self.previous is not None
        return (clean - self.previous) * (self._h(i) / self._h(i - 1))

    def _correct(self, i: int, clean: Tensor) -> Tensor:
        """UniC: redo step i (from node i to i + 1) now that the prediction at its end is known."""
        assert self.previous is not None
        assert self.start is not None
        h = self._h(i)
        result = self._first_order(i, self.start, self.previous)
        scale = -self.alpha[i + 1] * math.expm1(-h)
        ahead = clean - self.previous
        if self.earlier is None or not math.isfinite(self._h(i - 1)):
            return result + (0.5 * scale) * ahead
        # Weights that make the step exact for predictions quadratic in l (eq. 9 of the UniPC paper, two points).
        ratio = -self._h(i - 1) / h
        phi_1 = math.expm1(-h)
        phi_2 = phi_1 / -h - 1
        phi_3 = phi_2 / -h - 0.5
        moments = torch.tensor([phi_2 / phi_1, 2 * phi_3 / phi_1], dtype=torch.float64)
        matrix = torch.tensor([[1.0, 1.0], [ratio, 1.0]], dtype=torch.float64)
        behind_weight, ahead_weight = torch.linalg.solve(matrix, moments).tolist()
        behind = (self.earlier - self.previous) / ratio
        return result + scale * (behind_weight * behind + ahead_weight * ahead)


def integrate(x: Tensor, log_snr: Tensor, clean: Callable[[Tensor, int], Tensor], solver: SolverName) -> Tensor:
    """From noise at log_snr[0] to the last node. `clean(x, i)` predicts the clean latent at node i; it is called once
    for every node but the last."""
    state = Solver(solver, log_snr)
    for i in range(len(log_snr) - 1):
        x = state.step(i, x, clean(x, i))
    return x
