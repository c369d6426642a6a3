"""What each photo shows: features, and its own inverse depth, matched with the other photos where they overlap."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from cat3d_core.matching.config import SweepConfig
from cat3d_core.matching.layers import Residual, UNet, conv, resized, zeroed
from cat3d_core.matching.planes import inverse_depth_of, local_mean
from cat3d_core.matching.warp import Views, pair_maps, project, take

_GROUPS = 4
_SPREAD = (-5.0, 0.0)


@dataclass(frozen=True)
class Observed:
    """B photos, of one scene or several, seen once for all targets.

    image (B, 3, H, W); views (B); coarse (B, C, H/4, W/4) and fine (B, C', H/2, W/2) features; position and
    log_spread (B, 1, H/2, W/2): inverse depth as position t in [0, 1] of `planes.inverse_depth_of`, with the logarithm
    of its expected error; logits (B, D, H/4, W/4) over the photos' planes, for training.
    """

    image: Tensor
    views: Views
    coarse: Tensor
    fine: Tensor
    position: Tensor
    log_spread: Tensor
    logits: Tensor


class Encoder(nn.Module):
    """Image (B, 3, H, W), sides divisible by 16, to features at 1/2 and 1/4."""

    def __init__(self, config: SweepConfig) -> None:
        super().__init__()
        a, b, c, d = config.encoder
        self.enter = conv(3, a, 2, 5)
        self.unet = UNet(config.encoder)
        self.coarse, self.fine = conv(a, config.coarse_features, 2), conv(a, config.fine_features, size=1)
        self.context = conv(a, b, 2)

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """half (B, a, H/2, W/2); context (B, b, H/4, W/4); coarse and fine features."""
        half = F.silu(self.unet(self.enter(image - 0.5)))
        return half, F.silu(self.context(half)), self.coarse(half), self.fine(half)


class PhotoDepth(nn.Module):
    """Sweep of each photo's frustum through its partners, and what its own picture suggests."""

    planes: Tensor

    def __init__(self, config: SweepConfig) -> None:
        super().__init__()
        self.config = config
        half, context, planes, width = config.encoder[0], config.encoder[1], config.photo_planes, config.volume[0]
        self.own = nn.Sequential(Residual(context), nn.SiLU())
        self.guess = conv(context, planes)
        self.pair = nn.Sequential(nn.Linear(_GROUPS + 3, 16), nn.ReLU(), nn.Linear(16, 12), nn.ReLU())
        self.mix = nn.Linear(2 * 12 + 2 + context // 2, width)
        self.squeeze = conv(context, context // 2, size=1)
        self.place = nn.Parameter(torch.zeros(planes, width))
        self.volume = UNet(config.volume, 3)
        self.score = nn.Conv3d(width, 1, 3, padding=1)
        last = conv(32, 2)
        zeroed(last)
        self.finer = nn.Sequential(conv(half + width + 4, 32), Residual(32), Residual(32), nn.SiLU(), last)
        t = torch.linspace(0, 1, planes)
        self.register_buffer("planes", inverse_depth_of(t, config.nearest), persistent=False)

    def forward(
        self, half: Tensor, context: Tensor, coarse: Tensor, views: Views, partners: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Features of B photos; views (B); partners (B, P) rows of the photos each is matched with, P >= 0.

        Returns position (B, 1, H/2, W/2), its log_spread, and logits (B, D, H/4, W/4)."""
        own = self.own(context)
        guess = self.guess(own)
        b, planes, h, w = guess.shape
        pairs, seen = self._matched(coarse, views, partners, h, w)
        flat = self.squeeze(own).permute(0, 2, 3, 1)[:, None].expand(-1, planes, -1, -1, -1)
        volume = self.mix(torch.cat([pairs, seen, guess[..., None].to(pairs.dtype), flat.to(pairs.dtype)], -1))
        volume = volume + self.place.view(1, planes, 1, 1, -1).to(volume.dtype)
        volume = self.volume(volume.permute(0, 4, 1, 2, 3))
        logits = self.score(F.silu(volume))[:, 0].float() + guess.float()
        probability = logits.softmax(1)
        mode = local_mean(probability)
        mean = (probability * torch.linspace(0, 1, planes, device=mode.device).view(1, -1, 1, 1)).sum(1, keepdim=True)
        entropy = -(probability * (probability + 1e-6).log()).sum(1, keepdim=True)
        peak = (volume * probability[:, None].to(volume.dtype)).sum(2)
        hints = torch.cat([peak.float(), mode, mean, entropy / 3, probability.amax(1, keepdim=True)], 1)
        up = resized(hints, *half.shape[-2:])
        change, spread = self.finer(torch.cat([half, up.to(half.dtype)], 1)).float().chunk(2, 1)
        position = (resized(mode, *half.shape[-2:]) + 0.1 * change).clamp(0, 1)
        return position, (spread - 3).clamp(*_SPREAD), logits

    def _matched(self, coarse: Tensor, views: Views, partners: Tensor, h: int, w: int) -> tuple[Tensor, Tensor]:
        """(B, D, h, w, 24): mean and maximum over the partners that see it; (B, D, h, w, 1): share of partners."""
        b, count = partners.shape
        planes = self.planes.view(1, -1, 1, 1).expand(b, -1, h, w)
        if count == 0:
            empty = torch.zeros(b, planes.shape[1], h, w, 25, device=coarse.device)
            return empty[..., :24], empty[..., 24:]
        maps = pair_maps(views, views[partners])
        at = project(maps, planes)
        there = take(coarse[partners.flatten()], at.grid.flatten(0, 1)).unflatten(0, (b, count))
        here = coarse.float()[:, None, :, None]
        agree = (there * here).unflatten(2, (_GROUPS, -1)).mean(3)  # (B, P, groups, D, h, w)
        valid = at.valid[:, :, None].to(agree.dtype)
        parallax = (maps.baseline[..., None, None, None] * planes[:, None]).clamp(max=3)[:, :, None] / 3
        scale = (at.inverse_depth / planes[:, None].clamp(min=1e-3)).clamp(max=4)[:, :, None] / 4
        x = torch.cat([agree * valid, valid, parallax, scale], 2).permute(0, 1, 3, 4, 5, 2)
        x = self.pair(x) * valid.permute(0, 1, 3, 4, 5, 2)
        total = valid[:, :, 0].sum(1)[..., None]
        return torch.cat([x.sum(1) / total.clamp(min=1), x.amax(1)], -1), total / count
