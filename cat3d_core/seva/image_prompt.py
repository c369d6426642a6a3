"""The one token by which SEVA's network knows what a window shows: the mean CLIP embedding of the given views."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from cat3d_core.metrics.clip import ClipImageTower, normalized


def embed(tower: ClipImageTower, images: Tensor) -> Tensor:
    """CLIP embeddings [B, D], not of unit length, of images [B, 3, H, W] in [0, 1]."""
    return tower.embed(normalized(squashed(images.to(tower.proj.dtype), tower.config.size)))


def context(embeddings: Tensor) -> Tensor:
    """[1, D], the one token of a window, from the embeddings [M, D] of its given views, each as often as it is in it.
    Raises ValueError for none."""
    if not len(embeddings):
        raise ValueError("A window needs at least one given view.")
    return embeddings.mean(0, keepdim=True)


def squashed(images: Tensor, size: int) -> Tensor:
    """Images [B, 3, H, W] -> [B, 3, size, size]: all of the picture, whatever its shape, resampled bicubically with
    corner centres on corner centres, after a Gaussian blur where it shrinks (as kornia's antialiased `resize`)."""
    height, width = images.shape[-2:]
    if (height, width) == (size, size):
        return images
    factors = (height / size, width / size)
    if max(factors) > 1:
        for axis, factor in zip((-2, -1), factors):
            images = _blurred(images, factor, axis)
    return F.interpolate(images, (size, size), mode="bicubic", align_corners=True)


def _blurred(images: Tensor, factor: float, axis: int) -> Tensor:
    """A Gaussian along one axis, of standard deviation (factor - 1) / 2 pixels, borders reflected."""
    sigma = max((factor - 1) / 2, 0.001)
    reach = int(max(4 * sigma, 3)) // 2  # an odd number of taps: 2 reach + 1
    position = torch.arange(-reach, reach + 1, dtype=torch.float64) / sigma
    weights = torch.exp(-0.5 * position**2)
    weights = (weights / weights.sum()).to(images)
    shape = [1, 1, 1, 1]
    shape[axis] = len(weights)
    kernel = weights.reshape(shape).expand(images.shape[1], 1, *shape[2:])
    padding = [reach, reach, 0, 0] if axis == -1 else [0, 0, reach, reach]
    return F.conv2d(F.pad(images, padding, mode="reflect"), kernel, groups=images.shape[1])
