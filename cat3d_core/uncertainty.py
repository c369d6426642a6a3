"""How little a field knows of what a camera sees: rays whose end is uncertain, and places no view has seen."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from cat3d_core.cameras import Cameras


def ray_entropy(weights: Tensor) -> Tensor:
    """(R,) in [0, 1]: entropy of where a ray ends, from its compositing weights (R, n) and what passes through, over
    that of a ray that may end anywhere (Lee et al. 2022, "Uncertainty guided policy for active robotic 3D
    reconstruction using neural radiance fields")."""
    passed = (1 - weights.sum(-1, keepdim=True)).clamp(min=0)
    share = torch.cat([weights, passed], -1)
    share = share / share.sum(-1, keepdim=True).clamp(min=torch.finfo(share.dtype).tiny)
    return torch.special.entr(share).sum(-1) / math.log(share.shape[-1])


def unseen(points: Tensor, cameras: Cameras) -> Tensor:
    """(P,) bool: which of the world points (P, 3) are in the image of none of the cameras."""
    pixels, depth = cameras.project(points.to(cameras.intrinsics))
    inside = (depth > 0) & (pixels >= 0).all(-1) & (pixels <= cameras.size[:, None].to(pixels)).all(-1)
    return ~inside.any(0)
