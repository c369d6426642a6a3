"""SEVA as one thing: network, Stable Diffusion 2.1's autoencoder and OpenCLIP's ViT-H image tower, all from files that
the user has; and the memory that they need."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from cat3d_core.diffusion.foreign_autoencoders import KLAutoencoder, TinyAutoencoder, load_autoencoder
from cat3d_core.diffusion.memory import Need, peak_bytes, weight_bytes
from cat3d_core.metrics.clip import ClipConfig, ClipImageTower, load_clip
from cat3d_core.seva import image_prompt
from cat3d_core.seva.checkpoint import load_seva
from cat3d_core.seva.config import SevaConfig
from cat3d_core.seva.network import SevaUNet

#: Of Stable Diffusion 1.x and 2.x: latents are the posterior's mean times this.
LATENT_SCALE = 0.18215
#: Stable Diffusion 2.1's autoencoder and OpenCLIP's ViT-H/14, as far as memory depends on them.
_AUTOENCODER: dict[str, Any] = {
    "block_out_channels": [128, 256, 512, 512],
    "layers_per_block": 2,
    "latent_channels": 4,
    "norm_num_groups": 32,
}
_TOWER = ClipConfig(1280, 32, 5120, 14, 224, 1024, 16, quick_gelu=False)


@dataclass(frozen=True)
class SevaModel:
    """The network in its own dtype, autoencoder and image tower in float32, all frozen."""

    network: SevaUNet
    autoencoder: KLAutoencoder | TinyAutoencoder
    tower: ClipImageTower

    @property
    def config(self) -> SevaConfig:
        return self.network.config

    @property
    def device(self) -> torch.device:
        return self.network.conv_in.weight.device

    @torch.no_grad()
    def encode(self, images: Tensor) -> Tensor:
        """Latents [B, 4, H/8, W/8] of images [B, 3, H, W] in [0, 1], one at a time: a large image takes gigabytes."""
        return torch.cat([self.autoencoder.encode(image[None]) for image in images])

    @torch.no_grad()
    def decode(self, latents: Tensor) -> Tensor:
        """Images [B, 3, H, W] in [0, 1] of latents [B, 4, H/8, W/8], one at a time."""
        return torch.cat([self.autoencoder.decode(latent[None].float()) for latent in latents])

    @torch.no_grad()
    def embed(self, images: Tensor) -> Tensor:
        """Image embeddings [B, C] of images [B, 3, H, W] in [0, 1]."""
        return image_prompt.embed(self.tower, images)


def load_seva_model(
    weights: Path, autoencoder: Path, tower: Path, device: torch.device | str = "cpu", dtype: torch.dtype | None = None
) -> SevaModel:
    """The model of a file of SEVA's weights, a diffusers `vae` folder and a file with OpenCLIP's image tower.

    dtype: of the network; None: that of its file. Raises ValueError or FileNotFoundError naming the part that is
    missing, damaged or of another model.
    """
    network = load_seva(weights, device, dtype)
    first_stage = load_autoencoder(autoencoder)
    scale = getattr(first_stage, "scale", LATENT_SCALE)
    with torch.no_grad():
        channels = first_stage.encode(torch.zeros(1, 3, 64, 64)).shape[1]
    if channels != network.config.latent_channels or abs(scale - LATENT_SCALE) > 1e-6:
        raise ValueError(
            f"{autoencoder} is not the autoencoder of Stable Diffusion 2.1: its latents have {channels} channels and "
            f"the scale {scale:g}, SEVA's {network.config.latent_channels} and {LATENT_SCALE}."
        )
    images = load_clip(tower, quick_gelu=False)
    if images.config.dimensions != network.config.context_channels:
        raise ValueError(
            f"{tower} is not OpenCLIP's ViT-H/14: its embeddings have {images.config.dimensions} dimensions, SEVA "
            f"takes {network.config.context_channels}."
        )
    return SevaModel(network, first_stage.to(device), images.to(device))


@lru_cache(maxsize=16)  # it takes seconds, and is asked for before each start
def seva_need(
    config: SevaConfig,
    groups: int,
    views: int | None = None,
    size: int | None = None,
    dtype: torch.dtype = torch.float16,
    beside: int | None = None,
) -> Need:
    """Memory of sampling so many windows of `views` square views of `size` pixels at once with guidance (twice as many
    in the network), and of encoding and decoding one view. beside: bytes of the weights of autoencoder and tower."""
    views, size = views or config.views, size or config.image_size
    side = size // 8
    with torch.device("meta"):
        network = SevaUNet(config).to(dtype)
        autoencoder, tower = KLAutoencoder(_AUTOENCODER), ClipImageTower(_TOWER)
        latents, mask = torch.empty(2 * groups, views, 4, side, side), torch.empty(2 * groups, views)
        rays, time = torch.empty(2 * groups, views, 6, side, side), torch.empty(2 * groups)
        context, image = torch.empty(2 * groups, 1, config.context_channels), torch.empty(1, 3, size, size)
    work = max(
        peak_bytes(lambda: network(latents, time, rays, mask, context)),
        peak_bytes(lambda: autoencoder.decode(autoencoder.encode(image))),
    )
    others = weight_bytes([autoencoder, tower]) if beside is None else beside
    return Need(weight_bytes([network]) + others, work)
