"""Classifier-free guidance (Ho & Salimans 2022), on an interval of noise levels (Kynkaanniemi et al. 2024)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from cat3d_core.diffusion.conditioning import Condition, Drop, drop_condition


@dataclass(frozen=True)
class GuidanceConfig:
    """prediction = unconditional + scale * (conditional - unconditional), at noise levels with log-SNR in
    [low_log_snr, high_log_snr]; elsewhere the conditional prediction alone, and the unconditional half is not computed.
    drop: what the unconditional half does without."""

    scale: float = 3.0
    low_log_snr: float = -math.inf
    high_log_snr: float = math.inf
    drop: Drop = "images_and_poses"

    def active(self, log_snr: float) -> bool:
        return self.scale != 1.0 and self.low_log_snr <= log_snr <= self.high_log_snr


def guided(
    predict: Callable[[Condition, Tensor], Tensor],
    condition: Condition,
    x: Tensor,
    log_snr: float,
    config: GuidanceConfig,
) -> Tensor:
    """predict(condition, x [G, N, C, h, w]) -> float32 prediction of that shape; both halves run as one batch of 2G."""
    if not config.active(log_snr):
        return predict(condition, x)
    groups = x.shape[0]
    latents, cameras, mask, hints = condition
    doubled = Condition(
        torch.cat([latents, latents]),
        torch.cat([cameras, cameras]),
        torch.cat([mask, mask]),
        None if hints is None else torch.cat([hints, hints]),
    )
    dropped = torch.arange(2 * groups, device=x.device) >= groups
    both = predict(drop_condition(doubled, dropped, config.drop), torch.cat([x, x]))
    conditional, unconditional = both[:groups], both[groups:]
    return unconditional + config.scale * (conditional - unconditional)
