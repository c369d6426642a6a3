"""The sweep of a target's own frustum through the photos: coarse over all planes, then fine over a few hypotheses."""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from cat3d_core.matching import warp_cpu
from cat3d_core.matching.config import SweepConfig
from cat3d_core.matching.layers import Residual, UNet
from cat3d_core.matching.photos import Observed
from cat3d_core.matching.planes import position_of, quantiles
from cat3d_core.matching.warp import Maps, pixel_grid, project, take

_EVIDENCE = 8
_LEAST_WEIGHT = 1e-2


class Gathered(NamedTuple):
    """Per photo and hypothesis: voxels (N, M, K, h, w, C + 8), features and evidence; valid (N, M, K, h, w), 1 inside
    the photo's image; agreement (N, M, K, h, w): logarithm of how well the photo's own depth agrees, at most 0."""

    voxels: Tensor
    valid: Tensor
    agreement: Tensor


def gather(
    features: Tensor, observed: Observed, photos: Tensor, maps: Maps, inverse_depth: Tensor, nearest: float
) -> Gathered:
    """Read features (B, C, h', w') and the photos' own depth where the hypotheses (N, K, h, w) fall.

    photos (N, M): the rows of `observed` that each target is swept through. By the C++ kernel where there is one."""
    own = torch.cat([observed.position, observed.log_spread], 1)
    if inverse_depth.dtype == torch.float32 and warp_cpu.available(features):
        return Gathered(*warp_cpu.gather(features, own, photos, maps, inverse_depth, nearest))
    return gather_reference(features, own, photos, maps, inverse_depth, nearest)


def gather_reference(
    features: Tensor, own: Tensor, photos: Tensor, maps: Maps, inverse_depth: Tensor, nearest: float
) -> Gathered:
    """`gather` in plain torch; own (B, 2, h'', w''): the photos' position and log_spread."""
    at = project(maps, inverse_depth)
    n, m = photos.shape
    grid, rows = at.grid.flatten(0, 1), photos.flatten()
    read = take(features[rows], grid).unflatten(0, (n, m))
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
    return Gathered(torch.cat([read.permute(0, 1, 3, 4, 5, 2), evidence], -1), valid, agreement)


def pool(hidden: Tensor, valid: Tensor) -> Tensor:
    """Any number of photos, in any order, to one vector a voxel: weighted mean and variance over those that see it.

    hidden (N, M, ..., C + 1): the logit of the weight, then numbers that are cut at 0; valid (N, M, ...) ->
    (N, ..., 2 C + 2): mean, variance, sum of weights, share of photos that see it.
    By the C++ kernel where there is one."""
    if valid.dtype == torch.float32 and warp_cpu.available(hidden):
        return warp_cpu.pool(hidden, valid)
    return pool_reference(hidden, valid)


def pool_reference(hidden: Tensor, valid: Tensor) -> Tensor:
    """`pool` in plain torch."""
    weight = valid[..., None] * (torch.sigmoid(hidden[..., :1]) + _LEAST_WEIGHT)
    x, total = F.relu(hidden[..., 1:]), weight.sum(1)
    share = weight / total.clamp(min=_LEAST_WEIGHT)[:, None]
    mean = (x * share).sum(1)
    variance = ((x - mean[:, None]).square() * share).sum(1)
    return torch.cat([mean, variance, total, valid.mean(1)[..., None].to(mean.dtype)], -1)


class Aggregate(nn.Module):
    """What is gathered from the photos, to one vector a voxel."""

    def __init__(self, features: int, hidden: int, extra: int, width: int) -> None:
        super().__init__()
        self.enter = nn.Linear(features + _EVIDENCE, hidden)
        self.hidden = nn.Linear(hidden, hidden + 1)
        self.leave = nn.Linear(2 * hidden + 2 + extra, width)

    def forward(self, gathered: Gathered, extra: Tensor) -> tuple[Tensor, Tensor]:
        """extra (N, K, h, w, E) -> volume (N, width, K, h, w) and each photo's hidden vectors (N, M, K, h, w, C)."""
        hidden = self.hidden(F.relu(self.enter(gathered.voxels)))
        pooled = pool(hidden, gathered.valid)
        out = self.leave(torch.cat([pooled, extra.to(pooled.dtype)], -1))
        return out.permute(0, 4, 1, 2, 3), F.relu(hidden[..., 1:])


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
        planes, (height, width) = volume.shape[2], share.shape[-2:]
        xy = pixel_grid(height, width, share.device)
        z = (share * 2 - 1) * (planes - 1) / planes
        grid = torch.stack([xy[0].expand_as(z), xy[1].expand_as(z), z], -1)
        return F.grid_sample(volume.float(), grid, padding_mode="border", align_corners=False)
