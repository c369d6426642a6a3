"""Small random models shared by the diffusion tests."""

from __future__ import annotations

import dataclasses

import torch

from cat3d_core.diffusion import SIZES, ModelConfig, MultiViewModel, MultiViewUNet


def tiny(**unet_changes: object) -> ModelConfig:
    config = SIZES["tiny"]
    return dataclasses.replace(config, unet=dataclasses.replace(config.unet, **unet_changes))


def randomized(unet: MultiViewUNet, seed: int = 0, new_channels: bool = True) -> MultiViewUNet:
    """Random weights everywhere (a fresh network's branches are zero). new_channels=False leaves the raymap and mask
    channels of conv_in as they are at initialisation."""
    generator = torch.Generator().manual_seed(seed)
    fresh = unet.conv_in.weight.detach().clone()
    with torch.no_grad():
        for parameter in unet.parameters():
            scale = 1.0 / max(parameter[0].numel(), 1) ** 0.5 if parameter.dim() > 1 else 0.3
            parameter.copy_(torch.randn(parameter.shape, generator=generator) * scale)
        if not new_channels:
            unet.conv_in.weight[:, unet.config.latent_channels :] = fresh[:, unet.config.latent_channels :]
    return unet.eval()


def random_model(seed: int = 0, **unet_changes: object) -> MultiViewModel:
    torch.manual_seed(seed)
    model = MultiViewModel(tiny(**unet_changes)).eval().requires_grad_(False)
    randomized(model.unet, seed)
    return model


def matrices(groups: int, views: int, generator: torch.Generator) -> torch.Tensor:
    """Random cameras [groups, views, 4, 4] as the network wants them: any plane of rays, none degenerate."""
    out = torch.eye(4, dtype=torch.float64).repeat(groups, views, 1, 1)
    out[:, :, :3] += 0.5 * torch.rand(groups, views, 3, 4, generator=generator, dtype=torch.float64) - 0.25
    return out


def inputs(groups: int, views: int, given: int, seed: int = 0) -> tuple[torch.Tensor, ...]:
    """latents [G, V, 8, 8, 8], time [G], cameras [G, V, 4, 4], mask [G, V]."""
    g = torch.Generator().manual_seed(seed)
    mask = torch.zeros(groups, views)
    mask[:, :given] = 1
    return (
        torch.randn(groups, views, 8, 8, 8, generator=g),
        torch.rand(groups, generator=g) * 999,
        matrices(groups, views, g),
        mask,
    )
