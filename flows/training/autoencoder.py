"""The autoencoder of a training: taken from a file, or trained for a stated time."""

from __future__ import annotations

import copy
import dataclasses
import time
from collections.abc import Callable
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor

from cat3d_core.diffusion import (
    Autoencoder,
    AutoencoderConfig,
    autoencoder_loss,
    describe,
    load_model,
    load_state,
    save_state,
)
from cat3d_core.diffusion.autoencoder import ENCODER
from cat3d_core.diffusion.config import from_dict
from cat3d_core.random import generator


def photo_crops(pictures: Tensor, count: int, size: int, random: torch.Generator) -> Tensor:
    """(count, 3, size, size) random windows of photographs (M, 3, H, H), at random scales, resampled."""
    crops = []
    for _ in range(count):
        pick = int(torch.randint(len(pictures), (), generator=random))
        share, fy, fx, flip = torch.rand(4, generator=random).tolist()
        full = pictures.shape[-1]
        side = int(size + (full - size) * share**1.2)
        top, left = int(fy * (full - side)), int(fx * (full - side))
        window = pictures[pick : pick + 1, :, top : top + side, left : left + side]
        crop = F.interpolate(window, (size, size), mode="bilinear", antialias=True, align_corners=False)
        crops.append(crop.flip(-1) if flip < 0.5 else crop)
    return torch.cat(crops).clamp(0, 1)


def draw_images(renders: Tensor, photos: Tensor | None, count: int, random: torch.Generator) -> Tensor:
    """(count, 3, H, W) in [0, 1]: renders (B, 3, H, W) uint8, half of them replaced by windows of `photos`."""
    from_photos = 0 if photos is None else count // 2
    pick = torch.randint(len(renders), (count - from_photos,), generator=random)
    images = renders[pick].float() / 255
    if photos is None or not from_photos:
        return images
    return torch.cat([photo_crops(photos, from_photos, renders.shape[-1], random), images])


@torch.no_grad()
def reconstruction_psnr(autoencoder: Autoencoder, images: Tensor) -> float:
    """Mean PSNR in dB over images (B, 3, H, W)."""
    errors = [(autoencoder.decode(autoencoder.encode(i)) - i).square().mean((1, 2, 3)) for i in images.split(16)]
    return float((-10 * torch.cat(errors).log10()).mean())


def train_autoencoder(
    start: Autoencoder,
    renders: Tensor,
    photos: Tensor | None,
    seconds: float,
    batch: int = 16,
    learning_rate: float = 2e-3,
    seed: int = 0,
    device: torch.device | str = "cpu",
    perceptual: Callable[[Tensor, Tensor], Tensor] | None = None,
    perceptual_weight: float = 0.1,
    decoder_only: bool = False,
    report: Callable[[float, dict[str, float]], None] = lambda passed, numbers: None,
) -> Autoencoder:
    """A copy of `start`, trained for `seconds` (`autoencoder_loss`); the learning rate falls to zero over the time.

    renders (B, 3, H, W) uint8, photos (M, 3, S, S) in [0, 1] or None, both on the CPU. `decoder_only`: the encoder and
    the latents' normalisation stay, so that banks and denoisers keep their meaning.
    `report(share of time passed, numbers of the step)`.
    """
    torch.manual_seed(seed)
    device = torch.device(device)
    model = copy.deepcopy(start).requires_grad_(False).to(device=device)
    model.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    trained = [p.requires_grad_(True) for name, p in model.named_parameters()
               if not (decoder_only and name.startswith(ENCODER))]  # fmt: skip
    optimizer = torch.optim.AdamW(trained, lr=learning_rate, betas=(0.9, 0.99), weight_decay=1e-3)
    begun, step, passed = time.monotonic(), 0, 0.0
    while passed < 1:
        random = generator(seed, "autoencoder", step)
        optimizer.param_groups[0]["lr"] = learning_rate * min(1.0, (step + 1) / 60) * (1 - passed) ** 0.8
        images = draw_images(renders, photos, batch, random).to(device)
        noise = torch.randn(len(images), model.config.latent_channels, images.shape[-2] // 8, images.shape[-1] // 8,
                            generator=random).to(device) * (not decoder_only)  # fmt: skip
        with torch.autocast(device.type, torch.bfloat16):
            loss, numbers = autoencoder_loss(
                model, images, noise, perceptual=perceptual, perceptual_weight=perceptual_weight
            )
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(trained, 1.0)
        optimizer.step()
        step, passed = step + 1, (time.monotonic() - begun) / seconds
        report(min(passed, 1.0), numbers)
    if not decoder_only:
        model.calibrate(sample_images(renders, photos, generator(seed, "calibration")).to(device))
    model.to(memory_format=torch.contiguous_format)  # type: ignore[call-overload]
    return model.cpu().eval().requires_grad_(False)


def new_autoencoder(config: AutoencoderConfig, renders: Tensor, photos: Tensor | None, seed: int) -> Autoencoder:
    """Where a training from nothing starts: random weights, the linear part from the training's images."""
    torch.manual_seed(seed)
    model = Autoencoder(config)
    if config.linear:
        model.start_linear(sample_images(renders, photos, generator(seed, "principal components")))
    return model


def sample_images(renders: Tensor, photos: Tensor | None, random: torch.Generator) -> Tensor:
    """As many images of a training, (count, 3, H, W), as may pass through an encoder at once: 16 to 512."""
    return draw_images(renders, photos, max(16, min(512, 2**23 // renders[0, 0].numel())), random)


def save_autoencoder(path: Path, autoencoder: Autoencoder, provenance: dict) -> None:
    """Write the weights with their configuration and provenance."""
    state = dict(autoencoder.state_dict())
    save_state(path, state, {"autoencoder": dataclasses.asdict(autoencoder.config), "provenance": provenance})


def load_autoencoder(path: Path) -> Autoencoder:
    """The autoencoder of a model file, or of what `save_autoencoder` wrote. Raises ValueError for another file,
    FileNotFoundError if absent."""
    try:
        describe(path)
    except ValueError:
        state, document = load_state(path)
        if "autoencoder" not in document:
            raise ValueError(f"{path} is neither a model file nor an autoencoder of `cat3d train`.") from None
        autoencoder = Autoencoder(from_dict(AutoencoderConfig, document["autoencoder"]))
        autoencoder.load_state_dict(state)
        return autoencoder.eval().requires_grad_(False)
    return load_model(path).autoencoder
