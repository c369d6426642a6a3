"""The model as one thing: U-Net, autoencoder, configuration."""

from __future__ import annotations

from torch import nn

from cat3d_core.diffusion.autoencoder import Autoencoder
from cat3d_core.diffusion.config import ModelConfig
from cat3d_core.diffusion.unet import MultiViewUNet


class MultiViewModel(nn.Module):
    """p(target views | conditioning views, cameras). Its state dict is what a checkpoint file holds."""

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.config = config
        self.unet = MultiViewUNet(config.unet)
        self.autoencoder = Autoencoder(config.autoencoder)
