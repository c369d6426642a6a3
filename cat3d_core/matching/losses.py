"""What the plane sweep is trained on: exact colour, depth and visibility of its targets and photos."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from cat3d_core.matching.layers import enlarge
from cat3d_core.matching.network import Swept
from cat3d_core.matching.photos import Observed
from cat3d_core.matching.planes import position_of, soft_assignment
from cat3d_core.matching.warp import Views, agreeing

#: Weights of the terms of `losses`.
WEIGHTS = {
    "colour": 1.0, "blended": 0.7, "planes": 0.1, "depth": 1.0, "photo_planes": 0.2, "photo_depth": 0.1, "sure": 0.2,
}  # fmt: skip
# Mean absolute error of colour at which the confidence aimed at has fallen to 1 / e.
_TOLERANCE = 0.06


@dataclass(frozen=True)
class SweepBatch:
    """B photos and N targets, as rendered: image (B, 3, H, W), inverse_depth (B, H, W), views (B); partners (B, P) of
    the photos; photos (N, M) rows that each target is swept through; target (N), truth (N, 3, H, W), truth_depth
    (N, H, W), inverse too."""

    image: Tensor
    inverse_depth: Tensor
    views: Views
    partners: Tensor
    photos: Tensor
    target: Views
    truth: Tensor
    truth_depth: Tensor

    def to(self, device: torch.device | str) -> SweepBatch:
        """The batch on another device."""
        values = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        return SweepBatch(**{name: value.to(device) for name, value in values.items()})


def visible(batch: SweepBatch) -> Tensor:
    """(N, M, H, W) bool: whether each photo truly shows what the target's pixel shows."""
    return agreeing(batch.truth_depth, batch.target, batch.inverse_depth, batch.views, batch.photos)


def losses(out: Swept, observed: Observed, batch: SweepBatch, nearest: float) -> dict[str, Tensor]:
    """The terms, unweighted (`WEIGHTS`)."""
    truth, planes = batch.truth, out.coarse.shape[1]
    weight = (0.1 + 0.9 * visible(batch).any(1).float())[:, None]
    most = out.most.view(-1, 1, 1)
    share = (batch.truth_depth / most).clamp(max=1)
    assigned = F.avg_pool2d(soft_assignment(share, planes), 4)
    depth = (out.probability * (out.hypotheses / most[:, None] - share[:, None]).abs()).sum(1).mean()
    photo_truth = position_of(batch.inverse_depth, nearest).clamp(max=1)
    logits = observed.logits
    photo_assigned = F.avg_pool2d(soft_assignment(photo_truth, logits.shape[1]), 4)
    position, log_spread = (enlarge(x, photo_truth[:, None])[:, 0] for x in (observed.position, observed.log_spread))
    label = torch.exp(-(out.colour.detach() - truth).abs().mean(1, keepdim=True) / _TOLERANCE)
    return {
        "colour": (out.colour - truth).abs().mean() + 0.25 * dissimilarity(out.colour, truth),
        "blended": ((out.blended - truth).abs() * weight).mean()
        + 0.25 * dissimilarity(out.blended * weight + truth * (1 - weight), truth),
        "planes": -(assigned * out.coarse.log_softmax(1)).sum(1).mean(),
        "depth": depth,
        "photo_planes": -(photo_assigned * logits.log_softmax(1)).sum(1).mean(),
        "photo_depth": ((position - photo_truth).abs() * torch.exp(-log_spread) + log_spread).mean(),
        "sure": F.binary_cross_entropy_with_logits(out.confidence, label),
    }


def dissimilarity(a: Tensor, b: Tensor) -> Tensor:
    """1 - SSIM (Wang et al. 2004) over 5 x 5 boxes, mean; a, b (N, C, H, W)."""
    ma, mb = F.avg_pool2d(a, 5, 1), F.avg_pool2d(b, 5, 1)
    va, vb = F.avg_pool2d(a * a, 5, 1) - ma * ma, F.avg_pool2d(b * b, 5, 1) - mb * mb
    both = F.avg_pool2d(a * b, 5, 1) - ma * mb
    return (1 - (2 * ma * mb + 1e-4) * (2 * both + 9e-4) / ((ma * ma + mb * mb + 1e-4) * (va + vb + 9e-4))).mean()
