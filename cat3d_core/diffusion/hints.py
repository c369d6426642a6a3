"""What is known of a target view beforehand, as the network takes it: maps on the grid of the latents.

The plane sweep (`cat3d_core/matching`) carries what photos show to the target. The network gets of it, in this order:
latents of the warped picture, then the means over each latent's block of pixels of the maps in HINT_MAPS. The paper has
no such input.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from cat3d_core.diffusion.autoencoder import Autoencoder
from cat3d_core.diffusion.config import HINT_MAPS

#: Places of the maps among the channels, from the end; the spread follows the inverse depth.
CONFIDENCE, INVERSE_DEPTH = -3, -2


@torch.no_grad()
def hint_latents(autoencoder: Autoencoder, hints: Mapping[str, Tensor]) -> Tensor:
    """colour (N, 3, H, W) in [0, 1] and HINT_MAPS (N, H, W) -> (N, C + 4, H/8, W/8) float32, where the autoencoder is.

    Raises ValueError where a map is missing."""
    missing = sorted({"colour", *HINT_MAPS} - set(hints))
    if missing:
        raise ValueError(f"A hint consists of colour, {', '.join(HINT_MAPS)}; missing: {', '.join(missing)}.")
    where = autoencoder.latent_std.device
    latents = autoencoder.encode(hints["colour"].float().to(where)).float()
    maps = torch.stack([hints[name].float().to(where) for name in HINT_MAPS], 1)
    height, width = latents.shape[-2:]
    return torch.cat([latents, F.adaptive_avg_pool2d(maps, (height, width))], 1)


def rescaled(hints: Tensor, factor: Tensor) -> Tensor:
    """Hints (G, ..., C + 4, h, w) of scenes that were enlarged by `factor` (G,): inverse depths fall."""
    out = hints.clone()
    out[..., INVERSE_DEPTH:, :, :] /= factor.to(hints).reshape(-1, *[1] * (hints.ndim - 1))
    return out


@dataclass(frozen=True)
class Corruption:
    """What hints suffer in training, so that the network does not take them for the truth: probabilities.

    whole: a group has none; view: a target has none; masked: blocks of a target, up to `most` of its area, have none;
    noisy: noise of a standard deviation up to `noise` on the latents of a group's hints (as See3D's corruption)."""

    whole: float = 0.1
    view: float = 0.1
    masked: float = 0.3
    most: float = 0.4
    noisy: float = 0.3
    noise: float = 0.3


def corrupted(hints: Tensor, random: torch.Generator, how: Corruption | None = None) -> Tensor:
    """Hints (G, N, C + 4, h, w) as `how` says; the draw is made on the CPU and depends on `random` alone."""
    how = how or Corruption()
    groups, targets, _, height, width = hints.shape
    draw = torch.rand(groups, 2, generator=random)
    kept = (draw[:, :1] >= how.whole) & (torch.rand(groups, targets, generator=random) >= how.view)
    holes = torch.rand(groups, targets, generator=random) < how.masked
    share = how.most * torch.rand(groups, targets, 1, 1, generator=random)
    blocks = torch.rand(groups, targets, -(-height // 4), -(-width // 4), generator=random) < share
    blocks = blocks.repeat_interleave(4, -2).repeat_interleave(4, -1)[..., :height, :width]
    there = kept[..., None, None] & ~(holes[..., None, None] & blocks)
    strength = how.noise * torch.rand(groups, generator=random) * (draw[:, 1] < how.noisy)
    noise = torch.randn(*hints.shape[:2], hints.shape[2] - len(HINT_MAPS), height, width, generator=random)
    out = hints.clone()
    out[:, :, : -len(HINT_MAPS)] += (strength[:, None, None, None, None] * noise).to(hints)
    return out * there[:, :, None].to(hints)
