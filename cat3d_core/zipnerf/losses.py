"""Losses of the reconstruction and the trust in generated views."""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor

from cat3d_core.zipnerf import ray_intervals
from cat3d_core.zipnerf.config import ZipNerfConfig
from cat3d_core.zipnerf.coordinates import power_ladder
from cat3d_core.zipnerf.render import Round

#: z-depth in scene units below which the inverse depth rises no further, so that its gradient stays bounded.
NEAREST = 0.01


class Trust(Protocol):
    """Settings of `view_weights`, whatever is reconstructed (see ZipNerfConfig)."""

    @property
    def distance_falloff(self) -> float: ...
    @property
    def distance_unit(self) -> float: ...
    @property
    def generated_weight_final(self) -> float: ...


def charbonnier(difference: Tensor, eps: float) -> Tensor:
    """sqrt(d^2 + eps^2), elementwise (Zip-NeRF's data loss)."""
    return (difference.square() + eps * eps).sqrt()


def interlevel(proposals: list[Round], final: Round, blur: tuple[float, ...]) -> Tensor:
    """Spline inter-level loss (Zip-NeRF sec. 3), summed over proposals (see `ray_intervals.interlevel_reference`). The
    final histogram is a constant target; gradients flow to the proposals' weights only."""
    total = torch.zeros((), dtype=final.weights.dtype, device=final.weights.device)
    for proposal, halfwidth in zip(proposals, blur, strict=False):
        total = total + ray_intervals.interlevel(
            proposal.s, proposal.weights, final.s, final.weights.detach(), halfwidth
        )
    return total


def distortion(final: Round, config: ZipNerfConfig) -> Tensor:
    """Mean distortion of the final histograms over power-ladder distance (Zip-NeRF supplement)."""
    t = power_ladder(final.t, config.distortion_power, config.distortion_premult)
    return ray_intervals.distortion(t, final.weights).mean()


def inverse_depth(final: Round, target: Tensor, weight: Tensor) -> Tensor:
    """Mean over rays of weight (R,) times the Charbonnier distance between the rendered and the known inverse z-depth
    (R,), in 1 / scene units.

    Rendered is the expectation of 1 / z over where the ray ends; light that passes everything ends at infinity and adds
    nothing. Inverse depth is what a network that looks at one picture knows best: errors far away count less.
    """
    middle = 0.5 * (final.t[:, 1:] + final.t[:, :-1])
    rendered = (final.weights / middle.clamp_min(NEAREST)).sum(-1)
    return (weight * charbonnier(rendered - target, 1e-3)).mean()


def annealed(weight: float, until: float, progress: float) -> float:
    """`weight`, falling linearly to 0 at `until` (0: at once) of the training; progress in [0, 1]."""
    return weight * max(0.0, 1.0 - progress / until) if until > 0 else 0.0


def view_weights(centers: Tensor, captured: Tensor, config: Trust, progress: float) -> Tensor:
    """Loss weight (N,) of each view at `progress` in [0, 1] through training (CAT3D app., 'Distance based weighting').

    Captured views weigh 1; a generated view exp(-b s^2) * g with s the distance of its centre (N, 3, normalised units)
    to the nearest captured one, b rising linearly from 0 to `distance_falloff`, g falling from 1 to
    `generated_weight_final`.
    """
    if bool(captured.all()) or not bool(captured.any()):
        return torch.ones(len(centers), device=centers.device)
    distance = torch.cdist(centers, centers[captured]).amin(1) / config.distance_unit
    falloff = torch.exp(-progress * config.distance_falloff * distance.square())
    overall = 1.0 + progress * (config.generated_weight_final - 1.0)
    return torch.where(captured, 1.0, overall * falloff).to(torch.float32)
