"""Blocks of the plane sweep's networks. Volumes are (N, C, D, h, w), kept channels-last in memory."""

from __future__ import annotations

from collections.abc import Sequence

import torch.nn.functional as F
from torch import Tensor, nn


def conv(inputs: int, outputs: int, stride: int = 1, size: int = 3) -> nn.Conv2d:
    """A 2D convolution that keeps the image's extent."""
    return nn.Conv2d(inputs, outputs, size, stride, size // 2)


def enlarge(x: Tensor, like: Tensor) -> Tensor:
    """Nearest-neighbour resize of an image or a volume to the extent of `like`."""
    return F.interpolate(x, like.shape[2:], mode="nearest")


def resized(x: Tensor, height: int, width: int) -> Tensor:
    """Bilinear resize (whole area onto whole area), over a leading batch of any shape: (..., h, w)."""
    flat = x.reshape(-1, 1, *x.shape[-2:]) if x.dim() != 4 else x
    out = F.interpolate(flat, (height, width), mode="bilinear", align_corners=False)
    return out.reshape(*x.shape[:-2], height, width)


def zeroed(layer: nn.Conv2d | nn.Conv3d) -> None:
    """Make a layer answer 0 until it is trained."""
    for weight in layer.parameters():
        nn.init.zeros_(weight)


class Residual(nn.Module):
    """x + conv(act(conv(act(norm(x))))), in 2 or 3 dimensions; starts as the identity."""

    def __init__(self, width: int, dimensions: int = 2) -> None:
        super().__init__()
        kind = nn.Conv2d if dimensions == 2 else nn.Conv3d
        self.norm = nn.GroupNorm(max(1, width // 8), width)
        self.first, self.second = kind(width, width, 3, padding=1), kind(width, width, 3, padding=1)
        zeroed(self.second)

    def forward(self, x: Tensor) -> Tensor:
        return x + self.second(F.silu(self.first(F.silu(self.norm(x)))))


class UNet(nn.Module):
    """A U-Net of residual blocks with additive skips, in 2 or 3 dimensions; any extent."""

    def __init__(self, widths: Sequence[int], dimensions: int = 2) -> None:
        super().__init__()
        kind = nn.Conv2d if dimensions == 2 else nn.Conv3d
        pairs = list(zip(widths[:-1], widths[1:], strict=True))
        self.enter = nn.ModuleList([Residual(a, dimensions) for a in widths[:-1]])
        self.down = nn.ModuleList([kind(a, b, 3, 2, 1) for a, b in pairs])
        self.middle = nn.Sequential(Residual(widths[-1], dimensions), Residual(widths[-1], dimensions))
        self.up = nn.ModuleList([kind(b, a, 1) for a, b in pairs])
        self.leave = nn.ModuleList([Residual(a, dimensions) for a in widths[:-1]])

    def forward(self, x: Tensor) -> Tensor:
        kept = []
        for block, down in zip(self.enter, self.down, strict=True):
            x = block(x)
            kept.append(x)
            x = down(x)
        x = self.middle(x)
        for block, up in zip(reversed(self.leave), reversed(self.up), strict=True):  # type: ignore[call-overload]
            skip = kept.pop()
            x = block(skip + enlarge(up(x), skip))
        return x
