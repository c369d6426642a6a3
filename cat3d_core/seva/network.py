"""SEVA's network: given views, noisy views and their rays -> the noise in the noisy ones.

Written from a description of the network, not from its code. Weights are named as in diffusers' U-Net where that has
them; `map_proj` (rays in residual blocks) and `time_mix_blocks` are SEVA's own.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from cat3d_core.diffusion.attention import (
    Attention,
    FeedForward,
    SpatialTransformer,
    ViewFrames,
    fold_views,
    unfold_views,
)
from cat3d_core.diffusion.layers import Downsample, ResnetBlock, TimeMLP, Upsample, time_embedding
from cat3d_core.seva.config import SevaConfig

_RAY_CHANNELS = 6


class Inputs(NamedTuple):
    """What every block is given: time [G*V, C] after its SiLU, rays [G*V, 6, h, w], context [G*V, 1, C'], and V."""

    time: Tensor
    rays: Tensor
    context: Tensor
    views: int


class SevaUNet(nn.Module):
    """Predicts the noise of every view of G groups of V views."""

    def __init__(self, config: SevaConfig) -> None:
        super().__init__()
        self.config = config
        channels = config.channels
        last = len(channels) - 1
        self.conv_in = nn.Conv2d(config.latent_channels + 1 + _RAY_CHANNELS, channels[0], 3, padding=1)
        self.time_embedding = TimeMLP(channels[0], 4 * channels[0])
        self.down_blocks, self.up_blocks = nn.ModuleList(), nn.ModuleList()
        width, skips = channels[0], [channels[0]]
        for level, out in enumerate(channels):
            widths = [width] + [out] * (config.blocks - 1)
            down = Downsample(out) if level < last else None
            attentions = config.blocks if level < last else 0
            self.down_blocks.append(Level(config, "down", widths, out, attentions, False, down))
            skips += [out] * (config.blocks + (level < last))
            width = out
        self.mid_block = Level(config, "middle", [width, width], width, 1, True)
        for level, out in reversed(list(enumerate(channels))):
            widths = [w + skips.pop() for w in [width] + [out] * config.blocks]
            # Views meet on the way up, except at the largest size, where all their tokens would be too many.
            attentions = config.blocks + 1 if level < last else 0
            up = Upsample(out) if level else None
            self.up_blocks.append(Level(config, "up", widths, out, attentions, level > 0, up))
            width = out
        self.conv_norm_out = nn.GroupNorm(32, channels[0], eps=1e-5)
        self.conv_out = nn.Conv2d(channels[0], config.latent_channels, 3, padding=1)

    def forward(self, latents: Tensor, time: Tensor, rays: Tensor, mask: Tensor, context: Tensor) -> Tensor:
        """The noise in each view, [G, V, 4, h, w] in the dtype of the weights.

        latents [G, V, 4, h, w], h and w multiples of 8, scaled to variance 1 (`sampler`); time [G]: index of the noise
        level; rays [G, V, 6, h, w]: Plücker coordinates (`cameras.rays`); mask [G, V]: 1 where a view is given;
        context [G, 1, C] of each group or [G, V, C] of each view: image embedding. Raises ValueError for other sizes.
        """
        groups, views, _, height, width = latents.shape
        if height % 8 or width % 8:
            raise ValueError(
                f"Latents of {width} x {height} can't be halved three times: images for this network have sides that "
                f"are multiples of {self.config.multiple} pixels, not {8 * width} x {8 * height}."
            )
        dtype = self.conv_in.weight.dtype
        mask_map = mask.to(latents)[:, :, None, None, None].expand(-1, -1, 1, height, width)
        x = torch.cat([latents, mask_map, rays.to(latents)], 2).flatten(0, 1).to(dtype)
        each = context.to(dtype).expand(-1, views, -1).flatten(0, 1)[:, None]
        noise = self.folded(x, time.repeat_interleave(views), rays.flatten(0, 1).to(dtype), each, views)
        return noise.unflatten(0, (groups, views))

    def folded(self, x: Tensor, time: Tensor, rays: Tensor, context: Tensor, views: int) -> Tensor:
        """The same on groups and views folded into one: x [G*V, 11, h, w] (latent, mask, rays), time [G*V], rays
        [G*V, 6, h, w], context [G*V, 1, C] -> [G*V, 4, h, w]."""
        embedded = self.time_embedding(time_embedding(time, self.config.channels[0]).to(x.dtype))
        inputs = Inputs(F.silu(embedded), rays, context, views)
        x = self.conv_in(x)
        skips = [x]
        for level in (*self.down_blocks, self.mid_block, *self.up_blocks):
            x = level(x, skips, inputs)
        out: Tensor = self.conv_out(F.silu(self.conv_norm_out(x)))
        return out


class Level(nn.Module):
    """Residual blocks at one size, the first `attentions` followed by attention, in which views meet where `joint`."""

    def __init__(
        self,
        config: SevaConfig,
        side: Literal["down", "middle", "up"],
        widths: list[int],
        out: int,
        attentions: int,
        joint: bool,
        resample: Downsample | Upsample | None = None,
    ) -> None:
        super().__init__()
        self.side = side
        time_channels = 4 * config.channels[0]
        self.resnets = nn.ModuleList(ResnetBlock(w, out, time_channels, map_channels=_RAY_CHANNELS) for w in widths)
        self.attentions = nn.ModuleList(ViewTransformer(config, out, joint) for _ in range(attentions))
        if resample is not None:
            name = "downsamplers" if side == "down" else "upsamplers"
            self.add_module(name, nn.ModuleList([resample]))

    def forward(self, x: Tensor, skips: list[Tensor], inputs: Inputs) -> Tensor:
        """x [G*V, C, h, w]. The way down pushes its results to `skips`, the way up takes them back."""
        rays = resized(inputs.rays, x)
        for i, resnet in enumerate(self.resnets):
            x = resnet(torch.cat([x, skips.pop()], 1) if self.side == "up" else x, inputs.time, rays)
            if i < len(self.attentions):
                x = self.attentions[i](x, inputs.views, inputs.context)
            if self.side == "down":
                skips.append(x)
        for downsample in getattr(self, "downsamplers", []):
            x = downsample(x)
            skips.append(x)
        for upsample in getattr(self, "upsamplers", []):
            x = upsample(x)
        return x


class ViewTransformer(SpatialTransformer):
    """Stable Diffusion 2's transformer, and beside it one along the views at each place."""

    def __init__(self, config: SevaConfig, channels: int, joint: bool) -> None:
        heads = channels // config.head_channels
        super().__init__(channels, heads, "3d" if joint else "none", "vector", config.context_channels, True, 32)
        self.joint = joint
        self.time_mix_blocks = nn.ModuleList([TimeMixBlock(channels, heads, config.context_channels)])

    def mix(self, tokens: Tensor, views: int, context: Tensor | None, frames: ViewFrames | None) -> Tensor:
        """A group's views have one context where they meet: that of the first."""
        assert context is not None
        first = context[::views]
        own = first.repeat_interleave(views, 0) if self.joint else context
        tokens = super().mix(tokens, views, own, frames)
        return tokens + self.time_mix_blocks[0](tokens, views, first)


class TimeMixBlock(nn.Module):
    """A transformer block along the views at each place. It knows nothing of their order, and has no residual round
    its last layer: what it returns is added to its input outside."""

    def __init__(self, channels: int, heads: int, context_channels: int) -> None:
        super().__init__()
        self.norm_in, self.ff_in = nn.LayerNorm(channels), FeedForward(channels)
        self.norm1, self.attn1 = nn.LayerNorm(channels), Attention(channels, heads)
        self.norm2, self.attn2 = nn.LayerNorm(channels), Attention(channels, heads, context_channels)
        self.norm3, self.ff = nn.LayerNorm(channels), FeedForward(channels)

    def forward(self, tokens: Tensor, views: int, context: Tensor) -> Tensor:
        """tokens [G*V, L, C], context [G, 1, C'] -> [G*V, L, C]."""
        x = tokens + self.ff_in(self.norm_in(tokens))
        x = x + unfold_views(self.attn1(fold_views(self.norm1(x), views, "temporal")), views, x.shape[1], "temporal")
        together = fold_views(self.norm2(x), views, "3d")
        x = x + unfold_views(self.attn2(together, context), views, x.shape[1], "3d")
        out: Tensor = self.ff(self.norm3(x))
        return out


def resized(rays: Tensor, features: Tensor) -> Tensor:
    """Rays [B, 6, H, W] at the size of features [B, C, h, w]: bilinear, corner centres on corner centres."""
    return F.interpolate(rays, features.shape[-2:], mode="bilinear", align_corners=True)


def count_flops(config: SevaConfig, views: int) -> int:
    """Floating-point operations (2 per multiply-add) of one evaluation of one window of square views of the trained
    size, counted without computing it."""
    from torch.utils.flop_counter import FlopCounterMode

    side = config.image_size // 8
    with torch.device("meta"), torch.no_grad(), FlopCounterMode(display=False) as counter:
        latents, rays = torch.empty(1, views, config.latent_channels, side, side), torch.empty(1, views, 6, side, side)
        context = torch.empty(1, 1, config.context_channels)
        SevaUNet(config)(latents, torch.empty(1), rays, torch.empty(1, views), context)
    return int(counter.get_total_flops())


def count_parameters(config: SevaConfig) -> int:
    """Parameters of the network, counted without allocating them."""
    with torch.device("meta"):
        return sum(p.numel() for p in SevaUNet(config).parameters())
