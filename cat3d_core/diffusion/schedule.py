"""Noise levels: x = alpha * clean + sigma * noise with alpha^2 + sigma^2 = 1, described by log-SNR = log(alpha^2 /
sigma^2).

Tables are float64 on the CPU. With N target views the log-SNR is lowered by log N (paper, section 3.1, after 'simple
diffusion', Hoogeboom et al. 2023): N consistent images tell N times as much about a scene as one.
"""

from __future__ import annotations

import math
from typing import Literal

import torch
from torch import Tensor

from cat3d_core.diffusion.config import ScheduleConfig

Nodes = Literal["trailing", "linspace", "log_snr", "karras"]

# With zero terminal SNR the first node is pure noise (log-SNR -inf); nodes spaced in log-SNR start again from here.
# Below it the clean latent's estimate hardly differs from that of pure noise (sigma/alpha = 55).
LOWEST_LOG_SNR = -8.0


def alpha_sigma(log_snr: Tensor) -> tuple[Tensor, Tensor]:
    """Signal and noise amplitude; exact at +-inf."""
    return torch.sigmoid(log_snr).sqrt(), torch.sigmoid(-log_snr).sqrt()


class Schedule:
    """The table of `config.steps` log-SNRs, cleanest first, for a group with `targets` target views.

    log_snr [T] float64 decreasing; with zero terminal SNR the last is -inf.
    """

    def __init__(self, config: ScheduleConfig, targets: int) -> None:
        if targets < 1:
            raise ValueError(f"A group has at least one target view, not {targets}.")
        self.config = config
        self.base_log_snr = _base_table(config)
        self.log_snr = self.base_log_snr - (math.log(targets) if config.shift else 0.0)

    def time(self, log_snr: Tensor) -> Tensor:
        """The time that the network is given for noise levels: a fractional step of the unshifted table (time_input
        'noise') or of the shifted one ('index'). Any shape, float64."""
        table = self.base_log_snr if self.config.time_input == "noise" else self.log_snr
        return _invert(table, log_snr.double())

    def nodes(self, kind: Nodes, steps: int) -> Tensor:
        """log-SNRs [steps] at which the network is evaluated, noisiest first, float64.

        trailing: steps T-1, T-1-T/n, ... (Lin et al. 2023); linspace: from step T-1 to 0; log_snr: uniform in log-SNR
        over the table's range; karras: uniform in (sigma/alpha)^(1/7) (Karras et al. 2022). The last three end at step
        0, which takes 3 nodes at least; one or two steps are trailing ones whatever the kind.
        """
        if steps < 1:
            raise ValueError(f"The number of steps is {steps}; sampling needs at least one.")
        if steps < 3:
            kind = "trailing"
        table, count = self.log_snr, self.config.steps
        if steps > count and kind in ("trailing", "linspace"):
            raise ValueError(
                f"{kind!r} nodes are entries of a table of {count} steps, so there can't be {steps} different ones; "
                "use 'log_snr' or 'karras' nodes."
            )
        if kind == "trailing":
            index = torch.arange(steps, dtype=torch.float64) * (-count / steps) + count
            return table[index.round().long() - 1]
        if kind == "linspace":
            return table[torch.linspace(0, count - 1, steps, dtype=torch.float64).round().long().flip(0)]
        noisiest, cleanest = float(table[-1]), float(table[0])
        if math.isinf(noisiest):
            low = max(float(table[-2]), LOWEST_LOG_SNR)
            return torch.cat([table[-1:], _spaced(kind, low, cleanest, steps - 1)])
        return _spaced(kind, noisiest, cleanest, steps)

    def clean(self, x: Tensor, prediction: Tensor, log_snr: Tensor) -> Tensor:
        """The clean latent that a v- or eps-prediction at this (scalar) noise level stands for, in x's dtype."""
        alpha, sigma = (float(s) for s in alpha_sigma(log_snr.double()))
        if self.config.prediction == "v":
            return alpha * x - sigma * prediction
        return (x - sigma * prediction) / alpha


def _spaced(kind: Nodes, low: float, high: float, steps: int) -> Tensor:
    grid = torch.linspace(0, 1, steps, dtype=torch.float64)
    if kind == "log_snr":
        return low + grid * (high - low)
    if kind == "karras":
        rho = 7.0
        first, last = math.exp(-low / 2) ** (1 / rho), math.exp(-high / 2) ** (1 / rho)
        return -2 * rho * torch.log(first + grid * (last - first))
    raise ValueError(f"Unknown nodes {kind!r}: use trailing, linspace, log_snr or karras.")


def _base_table(config: ScheduleConfig) -> Tensor:
    steps = config.steps
    if config.base == "cosine":  # Nichol & Dhariwal 2021
        angle = (torch.arange(steps + 1, dtype=torch.float64) / steps + 0.008) / 1.008 * math.pi / 2
        cumulative = angle.cos() ** 2
        betas = (1 - cumulative[1:] / cumulative[:-1]).clamp(max=0.999)
    elif config.base == "scaled_linear":  # Stable Diffusion
        betas = torch.linspace(config.beta_start**0.5, config.beta_end**0.5, steps, dtype=torch.float64) ** 2
    else:
        betas = torch.linspace(config.beta_start, config.beta_end, steps, dtype=torch.float64)
    signal = torch.cumprod(1 - betas, 0).sqrt()
    if config.zero_terminal_snr:  # Lin et al. 2023, algorithm 1
        signal = (signal - signal[-1]) * signal[0] / (signal[0] - signal[-1])
    return 2 * (torch.log(signal) - 0.5 * torch.log1p(-(signal**2)))


def _invert(table: Tensor, log_snr: Tensor) -> Tensor:
    """The fractional index at which a decreasing table has these values, clamped to its ends.

    Linear in log-SNR between entries; before a last entry of -inf linear in alpha instead.
    """
    finite = table[:-1] if torch.isinf(table[-1]) else table
    ascending = finite.flip(0).contiguous()
    right = torch.searchsorted(ascending, log_snr.contiguous()).clamp(1, len(ascending) - 1)
    low, high = ascending[right - 1], ascending[right]
    position = right - 1 + ((log_snr - low) / (high - low)).clamp(0, 1)
    index = (len(ascending) - 1) - position
    if len(finite) < len(table):
        beyond = 1 - alpha_sigma(log_snr)[0] / alpha_sigma(finite[-1])[0]
        index = torch.where(log_snr < finite[-1], len(finite) - 1 + beyond, index)
    return index
