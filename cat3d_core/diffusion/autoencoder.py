"""Image <-> latent: a small convolutional variational autoencoder, 8 times smaller on each side, made for the CPU.

All work is done at half size and below (pixel unshuffle), where the channels are; a few million parameters. With
`linear` the networks correct a linear transform of 8 x 8 blocks, which `start_linear` sets to the principal components
of training images: before any training that gave 29.1 dB on photographs on which 15 minutes of training from random
weights had given 27.3 dB.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from cat3d_core.diffusion.config import AutoencoderConfig
from cat3d_core.diffusion.layers import Downsample, ResnetBlock, Upsample

#: Beginnings of the names of an Autoencoder's weights that make latents: while they stay, latents keep their meaning.
ENCODER = ("encoder.", "analysis.", "latent_")


class Autoencoder(nn.Module):
    """Images [B, 3, H, W] in [0, 1], H and W multiples of 8 <-> latents [B, C, H/8, W/8] of about unit variance.

    `latent_mean` and `latent_std` [C] (set by `calibrate`) normalise the latents; they are stored with the weights.
    """

    def __init__(self, config: AutoencoderConfig) -> None:
        super().__init__()
        self.config = config
        half, quarter, eighth = config.widths
        groups = config.norm_groups

        def blocks(channels: int, count: int) -> list[nn.Module]:
            return [ResnetBlock(channels, channels, None, groups) for _ in range(count)]

        self.encoder = nn.Sequential(
            nn.PixelUnshuffle(2),
            nn.Conv2d(12, half, 3, padding=1),
            *blocks(half, config.blocks[0]),
            Downsample(half),
            nn.Conv2d(half, quarter, 1),
            *blocks(quarter, config.blocks[1]),
            Downsample(quarter),
            nn.Conv2d(quarter, eighth, 1),
            *blocks(eighth, config.blocks[2]),
            nn.GroupNorm(groups, eighth),
            nn.SiLU(),
            nn.Conv2d(eighth, 2 * config.latent_channels, 3, padding=1),
        )
        self.decoder = nn.Sequential(
            nn.Conv2d(config.latent_channels, eighth, 3, padding=1),
            *blocks(eighth, config.blocks[2] + 1),
            nn.Conv2d(eighth, quarter, 1),
            Upsample(quarter),
            *blocks(quarter, config.blocks[1] + 1),
            nn.Conv2d(quarter, half, 1),
            Upsample(half),
            *blocks(half, config.blocks[0] + 1),
            nn.GroupNorm(groups, half),
            nn.SiLU(),
            nn.Conv2d(half, 12, 3, padding=1),
            nn.PixelShuffle(2),
        )
        if config.linear:
            self.analysis = nn.Conv2d(3, config.latent_channels, 8, stride=8)
            self.synthesis = nn.ConvTranspose2d(config.latent_channels, 3, 8, stride=8)
        self.latent_mean: Tensor
        self.latent_std: Tensor
        self.register_buffer("latent_mean", torch.zeros(config.latent_channels))
        self.register_buffer("latent_std", torch.ones(config.latent_channels))

    def posterior(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log-variance of the raw latents, each [B, C, H/8, W/8]."""
        if not images.numel() or images.shape[1] != 3 or images.shape[-1] % 8 or images.shape[-2] % 8:
            raise ValueError(
                f"Images are [B, 3, H, W], at least one, with sides that are multiples of 8, not {tuple(images.shape)}."
            )
        dtype = self.latent_mean.dtype
        signed = (images * 2 - 1).to(dtype)
        mean, log_variance = self.encoder(signed).chunk(2, 1)
        if self.config.linear:
            mean = mean + self.analysis(signed)
        return mean, log_variance.clamp(-30, 20)

    def encode(self, images: Tensor) -> Tensor:
        """Normalised mean latents [B, C, H/8, W/8]."""
        mean, _ = self.posterior(images)
        return (mean - self.latent_mean[:, None, None]) / self.latent_std[:, None, None]

    def decode(self, latents: Tensor) -> Tensor:
        """Images in [0, 1], float32."""
        raw = latents.to(self.latent_std.dtype) * self.latent_std[:, None, None] + self.latent_mean[:, None, None]
        return self.decode_raw(raw).float().clamp(0, 1)

    def decode_raw(self, raw: Tensor) -> Tensor:
        """Unclamped images from un-normalised latents (for training)."""
        signed: Tensor = self.decoder(raw)
        if self.config.linear:
            signed = signed + self.synthesis(raw)
        return signed * 0.5 + 0.5

    @torch.no_grad()
    def start_linear(self, images: Tensor) -> None:
        """Before training: blocks become their largest principal components over images [B, 3, H, W] and back, and the
        networks start as no correction. Component i, of standard deviation s_i, is kept at s_i ** 0.5: unlike a
        whitened one, such a latent has its coarse structure above its fine one at every noise level, as images have.

        Raises ValueError where the images hold fewer blocks than a block has numbers."""
        blocks = F.unfold(images.double() * 2 - 1, 8, stride=8).transpose(1, 2).flatten(0, 1)  # [N, 192]
        if len(blocks) < blocks.shape[1]:
            raise ValueError(f"{len(blocks)} blocks of 8 x 8 pixels are too few for principal components.")
        mean = blocks.mean(0)
        variance, axes = torch.linalg.eigh(torch.cov(blocks.T))
        count = self.config.latent_channels
        gain = variance[-count:].flip(0).clamp_min(1e-8) ** 0.25
        axes = axes[:, -count:].flip(1)
        self.analysis.weight.copy_((axes / gain).T.reshape(count, 3, 8, 8))
        self.analysis.bias.copy_(-mean @ (axes / gain))  # type: ignore[union-attr]
        self.synthesis.weight.copy_((axes * gain).T.reshape(count, 3, 8, 8))
        self.synthesis.bias.copy_(mean.reshape(3, 64).mean(1))  # type: ignore[union-attr]
        for last in (self.encoder[-1], self.decoder[-2]):
            nn.init.zeros_(last.weight)  # type: ignore[arg-type]
            nn.init.zeros_(last.bias)  # type: ignore[arg-type]

    @torch.no_grad()
    def calibrate(self, images: Tensor) -> None:
        """Set the latents' normalisation from a sample of training images [B, 3, H, W]: unit variance of every channel,
        or, with `linear`, of all of them together."""
        mean, log_variance = self.posterior(images)
        variance = mean.float().var((0, 2, 3)) + log_variance.float().exp().mean((0, 2, 3))
        self.latent_mean.copy_(mean.float().mean((0, 2, 3)))
        self.latent_std.copy_((variance.mean() if self.config.linear else variance).sqrt().clamp_min(1e-4))


def autoencoder_loss(
    autoencoder: Autoencoder,
    images: Tensor,
    noise: Tensor,
    kl_weight: float = 1e-6,
    gradient_weight: float = 0.5,
    perceptual: Callable[[Tensor, Tensor], Tensor] | None = None,
    perceptual_weight: float = 0.1,
) -> tuple[Tensor, dict[str, float]]:
    """L1 on pixels and on their differences to the neighbours (edges), a small KL term and, where it is given, a
    perceptual distance (Rombach et al. 2022, without the adversary).

    images [B, 3, H, W] in [0, 1]; noise [B, C, H/8, W/8] standard normal; perceptual(decoded, images) -> [B]. Returns
    the loss and numbers to log (psnr in dB of the clamped reconstruction).
    """
    mean, log_variance = autoencoder.posterior(images)
    decoded = autoencoder.decode_raw(mean + (0.5 * log_variance).exp() * noise.to(mean.dtype)).float()
    pixels = (decoded - images).abs().mean()
    edges = sum((decoded.diff(dim=d) - images.diff(dim=d)).abs().mean() for d in (-1, -2))
    kl = 0.5 * (mean.float() ** 2 + log_variance.float().exp() - 1 - log_variance.float()).sum((1, 2, 3)).mean()
    loss = pixels + gradient_weight * edges + kl_weight * kl
    mse = F.mse_loss(decoded.detach().clamp(0, 1), images)
    numbers = {"l1": pixels.item(), "kl": kl.item(), "psnr": -10 * mse.log10().item()}
    if perceptual is not None:
        distance = perceptual(decoded.clamp(0, 1), images).mean()
        loss = loss + perceptual_weight * distance
        numbers["perceptual"] = distance.item()
    return loss, {"loss": loss.item()} | numbers
