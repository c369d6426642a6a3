"""SEVA's noise levels, in this project's terms: a table of 1000 log-SNRs, and noise (epsilon) predicted.

Its sampler counts in sigma / alpha with x = clean + (sigma / alpha) noise; ours in x = alpha clean + sigma noise. The
two are one up to the factor alpha, and the Euler step of the former is the DDIM step of the latter, so all solvers
of `cat3d_core.diffusion` serve it.
"""

from __future__ import annotations

import torch
from torch import Tensor

from cat3d_core.diffusion.config import ScheduleConfig
from cat3d_core.diffusion.schedule import Nodes, Schedule

_CONFIG = ScheduleConfig(
    base="scaled_linear",
    beta_start=5e-6,
    beta_end=0.012,
    zero_terminal_snr=False,
    shift=False,
    prediction="eps",
    time_input="index",
)
#: The table's log-SNR is lowered by this: sigma / alpha is e^2.4 times that of its betas.
LOWERED = 4.8


class SevaSchedule(Schedule):
    """Noise levels are always entries of the table, since the network is given their index."""

    def __init__(self) -> None:
        super().__init__(_CONFIG, targets=1)
        self.log_snr = self.log_snr - LOWERED

    def time(self, log_snr: Tensor) -> Tensor:
        """Index of the entry of the table that is nearest in sigma / alpha: any shape, int64."""
        ratio, table = (torch.exp(-0.5 * level.double()) for level in (log_snr, self.log_snr))
        return (ratio[..., None] - table).abs().argmin(-1)

    def nodes(self, kind: Nodes, steps: int) -> Tensor:
        """log-SNRs [steps], noisiest first, float64. "trailing" is SEVA's own choice: the table's entries at
        floor(999 - 999 k / steps); other kinds are those of `Schedule`, moved to the nearest entry."""
        if kind != "trailing":
            index = self.time(super().nodes(kind, steps))
        else:
            last = len(self.log_snr) - 1
            index = torch.arange(steps) * last
            index = last - torch.div(index + steps - 1, steps, rounding_mode="floor")
        if len(index) < 1 or len(index.unique()) < len(index):
            raise ValueError(
                f"{steps} {kind} nodes are not {steps} different levels of SEVA's {len(self.log_snr)}: use from 1 to "
                f"{len(self.log_snr)} trailing ones, or fewer."
            )
        return self.log_snr[index]
