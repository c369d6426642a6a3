"""The multi-view U-Net: a text-to-image latent U-Net whose self-attention joins the views of a group."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from cat3d_core.diffusion.attention import SpatialTransformer, ViewFrames, zero_
from cat3d_core.diffusion.conditioning import camera_vectors, ray_features, view_matrices
from cat3d_core.diffusion.config import UNetConfig, ViewAttention
from cat3d_core.diffusion.layers import Downsample, ResnetBlock, TimeMLP, Upsample, time_embedding
from cat3d_core.rays import matrix_rays


class MultiViewUNet(nn.Module):
    """Parameters have the key names of diffusers' UNet2DConditionModel.

    At initialisation the output does not depend on rays, mask and hints (their input channels are zero), so that an
    inflated pretrained network starts as the network it was. Residual branches and the output start at zero, as in LDM.
    """

    def __init__(self, config: UNetConfig) -> None:
        super().__init__()
        self.config = config
        channels, time_channels = config.channels, 4 * config.channels[0]
        self.conv_in = nn.Conv2d(config.input_channels, channels[0], 3, padding=1)
        self.time_embedding = TimeMLP(channels[0], time_channels)
        if config.camera == "vector":
            self.camera_embedding = nn.Linear(8, config.cross_attention_dim)
        last = len(channels) - 1
        self.down_blocks = nn.ModuleList()
        skips = [channels[0]]
        width = channels[0]
        for level, out in enumerate(channels):
            widths = [width] + [out] * (config.blocks - 1)
            self.down_blocks.append(Level(config, level, widths, out, False, Downsample(out) if level < last else None))
            skips += [out] * config.blocks + ([out] if level < last else [])
            width = out
        self.mid_block = Level(config, last, [width, width], width, True, None, middle=True)
        self.up_blocks = nn.ModuleList()
        for level, out in reversed(list(enumerate(channels))):
            widths = [w + skips.pop() for w in [width] + [out] * config.blocks]
            self.up_blocks.append(Level(config, level, widths, out, True, Upsample(out) if level > 0 else None))
            width = out
        self.conv_norm_out = nn.GroupNorm(config.norm_groups, channels[0], eps=1e-5)
        self.conv_out = nn.Conv2d(channels[0], config.latent_channels, 3, padding=1)
        self._initialize()

    def _initialize(self) -> None:
        with torch.no_grad():
            self.conv_in.weight[:, self.config.latent_channels :] = 0
        zero_(self.conv_out)
        for module in self.modules():
            if isinstance(module, ResnetBlock):
                zero_(module.conv2)
            elif isinstance(module, SpatialTransformer):
                zero_(module.proj_out)

    def forward(
        self, latents: Tensor, time: Tensor, cameras: Tensor, mask: Tensor, hints: Tensor | None = None
    ) -> Tensor:
        """Predict v or eps for every view.

        latents [G, V, C, h, w]: clean where conditioning, noisy where target; time [G] the network's time, any float;
        cameras [G, V, 4, 4] seen from the first conditioning camera (`rays.reference_from_image`; zeros where the
        pose is dropped), best in float64; mask [G, V], 1 = conditioning view; hints [G, V, C + 4, h, w], zero where
        nothing is known (None: of no view), for a network that takes them.
        Returns [G, V, C, h, w] in the dtype of the weights.
        """
        groups, views, channels, height, width = latents.shape
        if channels != self.config.latent_channels:
            raise ValueError(
                f"The latents have {channels} channels, this U-Net works on {self.config.latent_channels}."
            )
        dtype = self.conv_in.weight.dtype
        mask_map = mask.to(latents.dtype)[:, :, None, None, None].expand(-1, -1, 1, height, width)
        parts = [latents, mask_map]
        if self.config.camera == "raymap":
            parts.insert(
                1, ray_features(matrix_rays(cameras, height, width).to(latents.dtype), self.config.ray_octaves)
            )
        if self.config.hints:
            empty = latents.new_zeros(groups, views, self.config.hint_channels, height, width)
            parts.append(empty if hints is None else hints.to(latents.dtype))
        x = torch.cat(parts, 2).flatten(0, 1).to(dtype)
        context = None
        if self.config.camera == "vector":
            context = self.camera_embedding(camera_vectors(cameras).to(dtype)).flatten(0, 1)[:, None]
        frames = None
        if self.config.relative_cameras:
            frames = ViewFrames(*(m.flatten(0, 1).to(dtype) for m in view_matrices(cameras)))
        embedded = self.time_embedding(time_embedding(time, self.config.channels[0]).to(dtype))
        embedded = F.silu(embedded).repeat_interleave(views, 0)

        x = self.conv_in(x)
        skips = [x]
        for down in self.down_blocks:
            x = down(x, skips, embedded, views, context, frames)
        x = self.mid_block(x, [], embedded, views, context, frames)
        for up in self.up_blocks:
            x = up(x, skips, embedded, views, context, frames)
        x = self.conv_out(F.silu(self.conv_norm_out(x)))
        return x.unflatten(0, (groups, views))


class Level(nn.Module):
    """Residual blocks, each followed by attention, at one resolution: of the down path, the middle or the up path."""

    def __init__(
        self,
        config: UNetConfig,
        level: int,
        widths: list[int],
        out: int,
        decoder: bool,
        resample: Downsample | Upsample | None,
        middle: bool = False,
    ) -> None:
        super().__init__()
        self.decoder = decoder and not middle
        self.middle = middle
        time_channels = 4 * config.channels[0]
        self.resnets = nn.ModuleList([ResnetBlock(w, out, time_channels, config.norm_groups) for w in widths])
        mode: ViewAttention = config.level_attention(level, decoder)
        if config.attention[level] or middle:
            self.attentions = nn.ModuleList(
                SpatialTransformer(
                    out,
                    config.heads[level],
                    mode,
                    config.camera,
                    config.cross_attention_dim,
                    config.linear_projection,
                    config.norm_groups,
                )
                for _ in range(1 if middle else len(widths))
            )
        if isinstance(resample, Downsample):
            self.downsamplers = nn.ModuleList([resample])
        elif isinstance(resample, Upsample):
            self.upsamplers = nn.ModuleList([resample])

    def forward(
        self,
        x: Tensor,
        skips: list[Tensor],
        time: Tensor,
        views: int,
        context: Tensor | None,
        frames: ViewFrames | None,
    ) -> Tensor:
        """x [G*V, C, h, w]. The down path pushes its results to `skips`, the up path takes them back."""
        attentions = getattr(self, "attentions", [])
        if self.middle:
            x = self.resnets[0](x, time)
            x = attentions[0](x, views, context, frames)
            middle_out: Tensor = self.resnets[1](x, time)
            return middle_out
        for i, resnet in enumerate(self.resnets):
            x = resnet(torch.cat([x, skips.pop()], 1) if self.decoder else x, time)
            if len(attentions):
                x = attentions[i](x, views, context, frames)
            if not self.decoder:
                skips.append(x)
        for downsample in getattr(self, "downsamplers", []):
            x = downsample(x)
            skips.append(x)
        for upsample in getattr(self, "upsamplers", []):
            x = upsample(x, (skips[-1].shape[-2], skips[-1].shape[-1]))
        return x


def count_flops(config: UNetConfig, views: int = 8) -> int:
    """Floating-point operations (2 per multiply-add) of one evaluation of one group, counted without computing it."""
    from torch.utils.flop_counter import FlopCounterMode

    size = config.latent_size
    with torch.device("meta"), torch.no_grad(), FlopCounterMode(display=False) as counter:
        latents = torch.empty(1, views, config.latent_channels, size, size)
        unet = MultiViewUNet(config)
        unet(latents, torch.empty(1), torch.empty(1, views, 4, 4), torch.empty(1, views))
    return int(counter.get_total_flops())


def count_parameters(config: UNetConfig) -> int:
    """Parameters of the U-Net, counted without allocating them."""
    with torch.device("meta"):
        return sum(p.numel() for p in MultiViewUNet(config).parameters())
