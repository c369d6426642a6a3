"""Solvers of the probability-flow ODE, as multistep exponential integrators on predictions of the clean latent.

In the half log-SNR l = log(alpha / sigma) the ODE is d(x / sigma)/dl = exp(l) clean(x, l), so from l_s to l_t, h = l_t
- l_s, x_t = sigma_t/sigma_s x_s + alpha_t (1 - exp(-h)) clean + corrections from how `clean` changed over the last
steps. DDIM is the first order (Song et al. 2021); DPM-Solver++(2M) the second order multistep (Lu et al. 2022); UniPC
adds a corrector that costs no evaluation (Zhao et al. 2023, B(h) = exp(h) - 1). Steps from pure noise (h = inf) and to
the clean latent (h = inf) are first order. Coefficients are float64 scalars, the state keeps its own dtype.

A further solver is a class here, with its name in SOLVERS; the configuration, the bench and the sampler take it from
there.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable

import torch
from torch import Tensor

from cat3d_core.diffusion.schedule import alpha_sigma


class Solver(ABC):
    """Walks along log-SNR nodes [n+1] float64 (increasing; the ends may be infinite), one `step` after the other."""

    def __init__(self, log_snr: Tensor) -> None:
        alpha, sigma = alpha_sigma(log_snr.double())
        self.alpha, self.sigma = alpha.tolist(), sigma.tolist()
        self.half = (log_snr.double() / 2).tolist()

    @abstractmethod
    def step(self, i: int, x: Tensor, clean: Tensor) -> Tensor:
        """From node i to node i + 1, given the state and the prediction `clean` of the clean latent at node i."""

    def _h(self, i: int) -> float:
        """Length of step i in half log-SNR."""
        return self.half[i + 1] - self.half[i]

    def _finite(self, i: int) -> bool:
        """Whether there is a step i, of finite length."""
        return i >= 0 and math.isfinite(self._h(i))

    def _first_order(self, i: int, x: Tensor, clean: Tensor) -> Tensor:
        gain = self.sigma[i + 1] / self.sigma[i]
        return gain * x + (-self.alpha[i + 1] * math.expm1(-self._h(i))) * clean


class Ddim(Solver):
    """First order: the prediction stays as it is over the step."""

    def step(self, i: int, x: Tensor, clean: Tensor) -> Tensor:
        return self._first_order(i, x, clean)


class DpmSolver(Solver):
    """DPM-Solver++(2M): the prediction goes on changing as it did over the last step."""

    previous: Tensor | None = None  # prediction at the node before the current one

    def step(self, i: int, x: Tensor, clean: Tensor) -> Tensor:
        result = self._first_order(i, x, clean)
        if self.previous is not None and self._finite(i) and self._finite(i - 1):
            slope = (clean - self.previous) * (self._h(i) / self._h(i - 1))
            # (1 - exp(-h)) / 2 times the change of `clean` over a step of this length, by the last difference.
            result = result + (0.5 * self.alpha[i + 1] * -math.expm1(-self._h(i))) * slope
        self.previous = clean
        return result


class UniPC(DpmSolver):
    """Each step is made once more when the prediction at its end is known, then the next one as in DPM-Solver++."""

    start: Tensor | None = None  # state from which the last step was made
    earlier: Tensor | None = None  # prediction two nodes back

    def step(self, i: int, x: Tensor, clean: Tensor) -> Tensor:
        if self.previous is not None and self.start is not None and self._finite(i - 1):
            x = self._correct(i - 1, self.start, self.previous, clean)
        earlier = self.previous
        result = super().step(i, x, clean)
        self.earlier, self.start = earlier, x
        return result

    def _correct(self, i: int, start: Tensor, previous: Tensor, clean: Tensor) -> Tensor:
        """UniC: step i (from node i to i + 1) from `start` and the prediction `previous` there, now that the prediction
        at its end is known."""
        h = self._h(i)
        result = self._first_order(i, start, previous)
        scale = -self.alpha[i + 1] * math.expm1(-h)
        ahead = clean - previous
        if self.earlier is None or not self._finite(i - 1):
            return result + (0.5 * scale) * ahead
        # Weights that make the step exact for predictions quadratic in l (eq. 9 of the UniPC paper, two points).
        ratio = -self._h(i - 1) / h
        phi_1 = math.expm1(-h)
        phi_2 = phi_1 / -h - 1
        phi_3 = phi_2 / -h - 0.5
        moments = torch.tensor([phi_2 / phi_1, 2 * phi_3 / phi_1], dtype=torch.float64)
        matrix = torch.tensor([[1.0, 1.0], [ratio, 1.0]], dtype=torch.float64)
        behind_weight, ahead_weight = torch.linalg.solve(matrix, moments).tolist()
        behind = (self.earlier - previous) / ratio
        return result + scale * (behind_weight * behind + ahead_weight * ahead)


#: By the name that `sample.solver` takes.
SOLVERS: dict[str, type[Solver]] = {"ddim": Ddim, "dpm++": DpmSolver, "unipc": UniPC}


def check_solver(name: str) -> None:
    """Raise ValueError unless there is a solver of this name."""
    if name not in SOLVERS:
        raise ValueError(f"There is no solver {name!r}; choose one of {', '.join(SOLVERS)}.")


def integrate(x: Tensor, log_snr: Tensor, clean: Callable[[Tensor, int], Tensor], solver: str) -> Tensor:
    """From noise at log_snr[0] to the last node. `clean(x, i)` predicts the clean latent at node i; it is called once
    for every node but the last. Raises ValueError for an unknown solver."""
    check_solver(solver)
    state = SOLVERS[solver](log_snr)
    for i in range(len(log_snr) - 1):
        x = state.step(i, x, clean(x, i))
    return x
