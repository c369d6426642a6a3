"""Convolutional parts shared by the U-Net and the autoencoders (key names as in diffusers)."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn


def time_embedding(time: Tensor, channels: int) -> Tensor:
    """Sinusoids of a (fractional) step: time [B] -> [B, channels] float32, cosines first (Vaswani et al.; SD's
    order)."""
    half = channels // 2
    frequency = torch.exp(-math.log(10000.0) * torch.arange(half, device=time.device, dtype=torch.float32) / half)
    angle = time.float()[:, None] * frequency
    return torch.cat([angle.cos(), angle.sin()], -1)


class TimeMLP(nn.Module):
    def __init__(self, channels: int, time_channels: int) -> None:
        super().__init__()
        self.linear_1 = nn.Linear(channels, time_channels)
        self.linear_2 = nn.Linear(time_channels, time_channels)

    def forward(self, x: Tensor) -> Tensor:
        out: Tensor = self.linear_2(F.silu(self.linear_1(x)))
        return out


class ResnetBlock(nn.Module):
    """Two convolutions with group norm and SiLU, a residual, and an optional bias from the time embedding.

    map_channels: what the first convolution sees is scaled and shifted, place by place, by a map of so many channels.
    """

    def __init__(
        self,
        channels_in: int,
        channels_out: int,
        time_channels: int | None,
        norm_groups: int = 32,
        eps: float = 1e-5,
        map_channels: int | None = None,
    ) -> None:
        super().__init__()
        self.norm1 = nn.GroupNorm(norm_groups, channels_in, eps=eps)
        self.map_proj = nn.Conv2d(map_channels, 2 * channels_in, 1) if map_channels else None
        self.conv1 = nn.Conv2d(channels_in, channels_out, 3, padding=1)
        self.time_emb_proj = nn.Linear(time_channels, channels_out) if time_channels else None
        self.norm2 = nn.GroupNorm(norm_groups, channels_out, eps=eps)
        self.conv2 = nn.Conv2d(channels_out, channels_out, 3, padding=1)
        self.conv_shortcut = nn.Conv2d(channels_in, channels_out, 1) if channels_in != channels_out else None

    def forward(self, x: Tensor, time: Tensor | None = None, maps: Tensor | None = None) -> Tensor:
        """x [B, C, h, w]; time [B, time_channels] after its SiLU; maps [B, map_channels, h, w]."""
        h = F.silu(self.norm1(x))
        if self.map_proj is not None:
            scale, shift = self.map_proj(maps).chunk(2, 1)
            h = h * (1 + scale) + shift
        h = self.conv1(h)
        if self.time_emb_proj is not None:
            h = h + self.time_emb_proj(time)[:, :, None, None]
        h = self.conv2(F.silu(self.norm2(h)))
        shortcut = x if self.conv_shortcut is None else self.conv_shortcut(x)
        out: Tensor = shortcut + h
        return out


class Downsample(nn.Module):
    """Half size by a strided convolution. `asymmetric`: pad right and bottom only (AutoencoderKL)."""

    def __init__(self, channels: int, asymmetric: bool = False) -> None:
        super().__init__()
        self.asymmetric = asymmetric
        self.conv = nn.Conv2d(channels, channels, 3, stride=2, padding=0 if asymmetric else 1)

    def forward(self, x: Tensor) -> Tensor:
        out: Tensor = self.conv(F.pad(x, (0, 1, 0, 1)) if self.asymmetric else x)
        return out


class Upsample(nn.Module):
    """Nearest-neighbour enlargement to `size` (default: double), then a convolution."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv = nn.Conv2d(channels, channels, 3, padding=1)

    def forward(self, x: Tensor, size: tuple[int, int] | None = None) -> Tensor:
        size = size or (2 * x.shape[-2], 2 * x.shape[-1])
        out: Tensor = self.conv(F.interpolate(x, size=size, mode="nearest"))
        return out
