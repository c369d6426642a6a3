"""The sweep of a target's own frustum through the photos: coarse over all planes, then fine over a few hypotheses."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from cat3d_core.matching.config import SweepConfig
from cat3d_core.matching.layers import Residual, UNet
from cat3d_core.matching.photos import Observed
from cat3d_core.matching.planes import position_of, quantiles
from cat3d_core.matching.warp import Maps, pixel_grid, project, take

_EVIDENCE = 8


@dataclass(frozen=True)
class Gathered:
    """Per photo and hypothesis: features (N, M, K, h, w, C), evidence (N, M, K, h, w, 8), valid (N, M, K, h, w, 1);
    agreement (N, M, K, h, w): logarithm of how well the photo's own depth agrees, at most 0."""

    features: Tensor
    evidence: Tensor
    valid: Tensor
    agreement: Tensor


def gather(
    features: Tensor, observed: Observed, photos: Tensor, maps: Maps, inverse_depth: Tensor, nearest: float
) -> Gathered:
    """Read features (B, C, h', w') and the photos' own depth where the hypotheses (N, K, h, w) fall.

    photos (N, M): the rows of `observed` that each target is swept through."""
    at = project(maps, inverse_depth)
    n, m = photos.shape
    grid, rows = at.grid.flatten(0, 1), photos.flatten()
    read = take(features[rows], grid).unflatten(0, (n, m))
    own = torch.cat([observed.position, observed.log_spread], 1)
    # The nearest pixel's depth: between two surfaces there is none in the middle.
    depth = take(own[rows], grid, "nearest").unflatten(0, (n, m))
    behind = depth[:, :, 0] - position_of(at.inverse_depth, nearest)  # > 0: the point is behind what the photo shows
    log_spread = depth[:, :, 1]
    units = behind * torch.exp(-log_spread)
    valid = at.valid.to(units.dtype)
    parallax = (maps.baseline[..., None, None, None] * inverse_depth[:, None]).clamp(max=3) / 3
    scale = (at.inverse_depth / inverse_depth[:, None].clamp(min=1e-3)).clamp(max=4) / 4
    evidence = torch.stack(
        [
            torch.exp(-units.abs()), torch.tanh(units / 2), torch.tanh(behind * 12), torch.exp(-(behind * 40).square()),
            log_spread / 3 + 1, valid, parallax, scale,
        ], -1,
    )  # fmt: skip
    agreement = torch.log(0.05 + 0.95 * torch.exp(-units.abs() / 2))
    return Gathered(read.permute(0, 1, 3, 4, 5, 2), evidence, valid[..., None], agreement)


class Aggregate(nn.Module):
    """Any number of photos, in any order, to one vector a voxel: weighted mean and variance over those that see it."""

    def __init__(self, features: int, hidden: int, extra: int, width: int) -> None:
        super().__init__()
        self.enter = nn.Linear(features + _EVIDENCE, hidden)
        self.hidden = nn.Linear(hidden, hidden + 1)
        self.leave = nn.Linear(2 * hidden + 2 + extra, width)

    def forward(self, gathered: Gathered, extra: Tensor) -> tuple[Tensor, Tensor]:
        """extra (N, K, h, w, E) -> volume (N, width, K, h, w) and each photo's hidden vectors (N, M, K, h, w, C)."""
        x = F.relu(self.enter(torch.cat([gathered.features, gathered.evidence], -1)))
        x = self.hidden(x)
        weight = gathered.valid.to(x.dtype) * (torch.sigmoid(x[..., :1]) + 1e-2)
        hidden = F.relu(x[..., 1:])
        total = weight.sum(1)
        mean = (hidden * weight).sum(1) / total.clamp(min=1e-2)
        variance = ((hidden - mean[:, None]).square() * weight).sum(1) / total.clamp(min=1e-2)
        seen = gathered.valid.mean(1).to(x.dtype)
        out = self.leave(torch.cat([mean, variance, total, seen, extra.to(x.dtype)], -1))
        return out.permute(0, 4, 1, 2, 3), hidden


class TargetDepth(nn.Module):
    """Distribution over a target's inverse depth, and how much each photo is to be believed at each hypothesis."""

    def __init__(self, config: SweepConfig) -> None:
        super().__init__()
        self.config = config
        width = config.volume[0]
        self.coarse = Aggregate(config.coarse_features, 24, 1, width)
        self.volume = UNet(config.volume, 3)
        self.score = nn.Conv3d(width, 1, 3, padding=1)
        self.fine = Aggregate(config.fine_features, 16, 2, width)
        self.settle = nn.Sequential(Residual(width, 3), Residual(width, 3), nn.SiLU())
        self.finer = nn.Conv3d(width, 4, 3, padding=1)
        self.trust = nn.Sequential(nn.Linear(16 + width, 24), nn.ReLU(), nn.Linear(24, 1))

    def forward(
        self, observed: Observed, photos: Tensor, maps: Maps, most: Tensor, height: int, width: int
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """photos (N, M) rows of `observed`; most (N,): the inverse depth of the targets' nearest plane.

        Returns coarse logits (N, D, H/4, W/4); hypotheses (N, K, H/2, W/2), shares of `most`; fine logits
        (N, K, H, W); trust (N, M, K, H/2, W/2), logits over the photos."""
        n, planes, count = len(photos), self.config.target_planes, self.config.hypotheses
        h, w = height // 4, width // 4
        most = most.view(n, 1, 1, 1)
        share = torch.linspace(0, 1, planes, device=most.device).view(1, -1, 1, 1).expand(n, -1, h, w)
        found = gather(observed.coarse, observed, photos, maps, share * most, self.config.nearest)
        volume, _ = self.coarse(found, share[..., None])
        volume = self.volume(volume)
        logits = self.score(F.silu(volume))[:, 0].float()

        h2, w2 = height // 2, width // 2
        coarse = F.interpolate(logits.detach().softmax(1), (h2, w2), mode="bilinear", align_corners=False)
        share, density = quantiles(coarse, count)
        found = gather(observed.fine, observed, photos, maps, share * most, self.config.nearest)
        spread = share - share.mean(1, keepdim=True)
        fine, hidden = self.fine(found, torch.stack([density.log() * 0.3, spread * 8], -1))
        fine = self.settle(fine + self._read(volume, share).to(fine.dtype))
        out = F.pixel_shuffle(self.finer(fine).float().transpose(1, 2).flatten(0, 1), 2).unflatten(0, (n, count))[
            :, :, 0
        ]
        own = fine.permute(0, 2, 3, 4, 1)[:, None].expand(*hidden.shape[:-1], -1)
        trust = self.trust(torch.cat([hidden, own.to(hidden.dtype)], -1))[..., 0].float() + found.agreement
        return logits, share, out, trust

    @staticmethod
    def _read(volume: Tensor, share: Tensor) -> Tensor:
        """The coarse volume at the hypotheses: (N, C, D, h, w), (N, K, H, W) -> (N, C, K, H, W)."""
        planes = volume.shape[2]
        xy = pixel_grid(*share.shape[-2:], share.device)
        z = (share * 2 - 1) * (planes - 1) / planes
        grid = torch.stack([xy[0].expand_as(z), xy[1].expand_as(z), z], -1)
        return F.grid_sample(volume.float(), grid, padding_mode="border", align_corners=False)
