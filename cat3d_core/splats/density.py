"""Where the Gaussians are: relocation, growth and noise of 3DGS as a Markov chain (Kheradmand et al. 2024)."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from cat3d_core.splats.gaussians import Gaussians

COPIES = 50
"""At most so many Gaussians take the place of one."""
_NODES = 64
_REACH = 8.5


def split(opacity: Tensor, copies: Tensor) -> tuple[Tensor, Tensor]:
    """Opacity and factor of the scales of each of `copies` (N,) Gaussians that together look like one of `opacity` (N,)
    in [0, 1): 1 - (1 - o)^(1/n), and the factor that keeps the integral of what a ray through them meets (MCMC eq. 9).

    The paper's double sum of alternating binomials is the integral over x, by sqrt(2 pi), of 1 - (1 - o' G(x))^n with
    G = exp(-x^2 / 2). All terms of the integral are positive, so it loses nothing; the trapezoid rule is exact to
    rounding for such functions.
    """
    copies = copies.to(opacity)
    less = torch.log1p(-opacity) / copies
    new = -torch.expm1(less)
    x = torch.linspace(-_REACH, _REACH, 2 * _NODES + 1, dtype=opacity.dtype, device=opacity.device)
    bell = torch.exp(-0.5 * x * x)
    together = -torch.expm1(copies[:, None] * torch.log1p(-new[:, None] * bell))
    total = together.sum(1) * (2 * _REACH / (2 * _NODES)) / math.sqrt(2 * math.pi)
    tiny = torch.finfo(opacity.dtype).tiny
    return new, torch.where(opacity > tiny, opacity / total.clamp_min(tiny), 1.0)


class Move(NamedTuple):
    """The Gaussians after a move; rows (K,) whose optimiser must forget what it knows; how many were dead."""

    gaussians: Gaussians
    changed: Tensor
    dead: int


def relocate(gaussians: Gaussians, added: int, dead_opacity: float, generator: torch.Generator) -> Move:
    """Dead Gaussians, and `added` new ones at the end, become copies of living ones, drawn by their opacity; these and
    their copies share what they looked like (`split`)."""
    opacity = gaussians.opacities
    alive = opacity > dead_opacity
    dead = (~alive).nonzero()[:, 0]
    place = torch.cat([dead, torch.arange(len(opacity), len(opacity) + added, device=dead.device)])
    if not len(place) or not bool(alive.any()):
        return Move(gaussians, place[:0], len(dead))
    # In the order of a running sum: torch.multinomial has a limit of 2^24 entries.
    running = (opacity * alive).double().cumsum(0)
    drawn = torch.rand(len(place), generator=generator, device=opacity.device, dtype=torch.float64) * running[-1]
    source = torch.searchsorted(running, drawn, right=True).clamp_max(len(opacity) - 1)
    copies = torch.bincount(source, minlength=len(opacity)) + 1
    new, factor = split(opacity, copies.clamp_max(COPIES))
    again = copies > 1
    eps = torch.finfo(new.dtype).eps
    logits = torch.where(again, new.clamp(dead_opacity, 1 - eps).logit(), gaussians.logits)
    scales = torch.where(again[:, None], gaussians.log_scales + factor.log()[:, None], gaussians.log_scales)
    rows = torch.arange(len(opacity) + added, device=dead.device)
    rows[place] = source
    moved = Gaussians(gaussians.means, gaussians.quaternions, scales, logits, gaussians.harmonics)[rows]
    return Move(moved, torch.cat([place, again.nonzero()[:, 0]]), len(dead))


def noise(gaussians: Gaussians, strength: float, generator: torch.Generator) -> Tensor:
    """(N, 3) random steps of the means, of `strength` standard deviations along the Gaussian's own axes; nothing where
    it is opaque (MCMC eq. 8 with its logistic of 100 (0.005 - opacity))."""
    draw = torch.randn(gaussians.means.shape, generator=generator, device=gaussians.means.device)
    gate = torch.sigmoid(100.0 * (0.005 - gaussians.opacities))
    return strength * gate[:, None] * (gaussians.rotations @ (gaussians.scales * draw)[..., None])[..., 0]
