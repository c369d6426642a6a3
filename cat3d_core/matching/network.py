"""The plane sweep: photos with cameras -> what a target camera would see of them, with depth and confidence."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from cat3d_core.matching.composite import Composite
from cat3d_core.matching.config import SweepConfig
from cat3d_core.matching.layers import UNet, conv, resized, zeroed
from cat3d_core.matching.photos import Encoder, Observed, PhotoDepth
from cat3d_core.matching.planes import inverse_depth_of
from cat3d_core.matching.targets import TargetDepth
from cat3d_core.matching.warp import Views, pair_maps, pixel_grid, project, take

_LEAST_MOST = 0.3


@dataclass(frozen=True)
class Swept:
    """N targets, all (N, ..., H, W).

    colour (3): the finished picture; blended (3): as warped, before finishing; confidence (1): logit of how right
    `colour` is expected to be; inverse_depth (1), expected, and spread (1), its standard deviation; seen (1): share of
    the distribution inside some photo's image; share (N, M, H, W): how much of the colour comes from each photo.
    For training: coarse logits (N, D, H/4, W/4), probability and hypotheses (N, K, H, W), most (N,).
    """

    colour: Tensor
    blended: Tensor
    confidence: Tensor
    inverse_depth: Tensor
    spread: Tensor
    seen: Tensor
    share: Tensor
    coarse: Tensor
    probability: Tensor
    hypotheses: Tensor
    most: Tensor


class Finish(nn.Module):
    """Mends the blended picture (holes, seams) and says how far it is to be trusted."""

    def __init__(self, config: SweepConfig, hints: int) -> None:
        super().__init__()
        width = config.finish[0]
        self.enter, self.unet, self.leave = conv(6 + hints, width), UNet(config.finish), conv(width, 3)
        self.sure = nn.Sequential(conv(hints + width, 24), nn.SiLU(), conv(24, 16), nn.SiLU(), conv(16, 1))
        zeroed(self.leave)

    def forward(self, blended: Tensor, nearest: Tensor, hints: Tensor) -> tuple[Tensor, Tensor]:
        x = self.unet(self.enter(torch.cat([blended * 2 - 1, nearest * 2 - 1, hints], 1)))
        sure = self.sure(torch.cat([hints.detach().to(x.dtype), F.silu(x).detach()], 1))
        return blended + self.leave(F.silu(x)).float(), sure.float()


class SweepNetwork(nn.Module):
    """One network for every number of photos. The paper has no such step; the model card says what it is worth.

    composite: how its pictures are put together with a sample of the diffusion model."""

    def __init__(self, config: SweepConfig | None = None) -> None:
        super().__init__()
        self.config, self.composite = config or SweepConfig(), Composite()
        self.encoder, self.photo = Encoder(self.config), PhotoDepth(self.config)
        self.target, self.finish = TargetDepth(self.config), Finish(self.config, 9)

    def observe(self, image: Tensor, views: Views, partners: Tensor) -> Observed:
        """Look at the photos once for all targets: (B, 3, H, W) in [0, 1], sides divisible by 16; partners (B, P): see
        the function `partners`."""
        half, context, coarse, fine = self.encoder(image)
        position, log_spread, logits = self.photo(half, context, coarse, views, partners)
        return Observed(image, views, coarse.float(), fine.float(), position, log_spread, logits)

    def forward(self, observed: Observed, photos: Tensor, target: Views, height: int, width: int) -> Swept:
        """N targets of height x width pixels (divisible by 16), each swept through the rows photos (N, M) of
        `observed`, in any order."""
        given = observed.views[photos]
        maps = pair_maps(target, given)
        most = nearest_plane(observed, photos, target, self.config.nearest)
        coarse, share, logits, trust = self.target(observed, photos, maps, most, height, width)
        probability = logits.softmax(1)
        share = resized(share, height, width)
        at = project(maps, share * most.view(-1, 1, 1, 1))
        colours = take(observed.image[photos.flatten()], at.grid.flatten(0, 1)).unflatten(0, photos.shape)
        trust = resized(trust, height, width)
        sharp, sharp_trust = self.config.sharpness
        chosen = (trust * sharp_trust).masked_fill(~at.valid, -20.0 * sharp_trust).softmax(1)
        blend = chosen * (logits * sharp).softmax(1)[:, None]  # (N, M, K, H, W)
        by_photo = (colours * blend[:, :, None]).sum(3)
        weight = blend.sum(2)
        blended = by_photo.sum(1)
        mean = (probability * share).sum(1, keepdim=True)
        spread = ((probability * (share - mean).square()).sum(1, keepdim=True) + 1e-6).sqrt()
        seen = (probability * at.valid.any(1)).sum(1, keepdim=True)
        hints = torch.cat(
            [
                probability.amax(1, keepdim=True) * 2 - 1, entropy(probability) / 0.9 - 1, seen * 2 - 1, spread * 8 - 1,
                disagreement(by_photo, weight) * 8,
                (trust.clamp(max=5).exp() * blend).sum((1, 2))[:, None].clamp(max=3),
                resized(coarse.softmax(1).amax(1, keepdim=True), height, width) * 3 - 1,
                (at.valid * probability[:, None]).sum(2).mean(1, keepdim=True) * 2 - 1, mean * 2 - 1,
            ], 1,
        )  # fmt: skip
        near = observed.image[photos.gather(1, closest(target, given)[:, None])[:, 0]]
        if near.shape[-2:] != (height, width):
            near = F.interpolate(near, (height, width), mode="bilinear", antialias=True)
        colour, sure = self.finish(blended, near, hints)
        scale = most.view(-1, 1, 1, 1)
        return Swept(
            colour, blended, sure, mean * scale, spread * scale, seen, weight, coarse, probability, share * scale, most
        )


def entropy(probability: Tensor) -> Tensor:
    """(N, K, ...) -> (N, 1, ...), in nats."""
    return -(probability * (probability + 1e-6).log()).sum(1, keepdim=True)


def disagreement(by_photo: Tensor, weight: Tensor) -> Tensor:
    """(N, 1, H, W): mean absolute difference of the photos' colours from the blended one, by their shares.

    by_photo (N, M, 3, H, W): colours times shares; weight (N, M, H, W)."""
    alone = by_photo / weight[:, :, None].clamp(min=1e-4)
    return ((alone - by_photo.sum(1, keepdim=True)).abs().mean(2) * weight).sum(1, keepdim=True)


def partners(pose: Tensor, at_most: int) -> Tensor:
    """Photos of one scene, pose (M, 4, 4) -> (M, min(at_most, M - 1)): the nearest others of each photo."""
    distance = camera_distance(pose, pose) + torch.eye(len(pose), device=pose.device) * 1e9
    return distance.argsort(-1)[:, : max(0, min(at_most, len(pose) - 1))]


def closest(target: Views, photos: Views) -> Tensor:
    """(N,): which of the photos (N, M) stands nearest to each target (N)."""
    return camera_distance(target.pose[:, None], photos.pose)[:, 0].argmin(-1)


def camera_distance(a: Tensor, b: Tensor) -> Tensor:
    """Distance of centres plus angle of viewing directions (radians) of all pairs of poses (..., A, 4, 4) and
    (..., B, 4, 4): (..., A, B)."""
    cosine = (a[..., :3, 2] @ b[..., :3, 2].mT).clamp(-1, 1)
    return torch.cdist(a[..., :3, 3], b[..., :3, 3]) + torch.acos(cosine)


@torch.no_grad()
def nearest_plane(observed: Observed, photos: Tensor, target: Views, nearest: float) -> Tensor:
    """(N,): inverse depth of each target's nearest plane: beyond 98 % of what the photos believe to show in it, with
    a margin; without such points, twice the unit distance's."""
    t = observed.position[:, 0, 1::2, 1::2]
    h, w = t.shape[-2:]
    d = inverse_depth_of(t, nearest).double()[photos].flatten(2)
    p = torch.cat([pixel_grid(h, w, t.device), torch.ones(1, h, w, device=t.device)]).double().reshape(3, -1)
    given = observed.views[photos]
    relative = torch.linalg.inv(target.pose.double())[:, None] @ given.pose.double()
    rays = relative[..., :3, :3] @ torch.linalg.inv(given.k.double()) @ p
    points = rays + relative[..., :3, 3:] * d[:, :, None]  # over the photo's depth
    image = target.k.double()[:, None] @ points
    z = points[:, :, 2]
    inside = (z > 1e-3) & (image[:, :, :2].abs() <= 1.1 * z[:, :, None]).all(2)
    inverse = (d / z.clamp(min=1e-3)).clamp(max=nearest)
    out = []
    for values, mask in zip(inverse, inside, strict=True):
        found = values[mask]
        out.append(1.2 * torch.quantile(found, 0.98) if len(found) >= 16 else found.new_tensor(2.0))
    return torch.stack(out).clamp(_LEAST_MOST, nearest).float()
