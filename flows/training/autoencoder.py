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
from cat3d_core.diffusion.config import from_dict
from cat3d_core.metrics.perceptual import PerceptualDistance
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
    config: AutoencoderConfig,
    renders: Tensor,
    photos: Tensor | None,
    seconds: float,
    batch: int,
    learning_rate: float,
    seed: int,
    device: torch.device | str,
    report: Callable[[float, int, float], None] = lambda passed, step, psnr: None,
) -> Autoencoder:
    """Train for `seconds`; renders (B, 3, H, W) uint8, photos (M, 3, S, S) in [0, 1] or None.

    The learning rate falls to zero over the time. `report(share of time passed, step, PSNR of the step in dB)`.
    """
    torch.manual_seed(seed)
    device = torch.device(device)
    model = Autoencoder(config).to(device=device)
    model.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    optimizer = torch.optim.AdamW(model.parameters(), lr=learning_rate, betas=(0.9, 0.99), weight_decay=1e-3)
    start, step, passed, record = time.monotonic(), 0, 0.0, {"psnr": 0.0}
    while passed < 1:
        random = generator(seed, "autoencoder", step)
        optimizer.param_groups[0]["lr"] = learning_rate * min(1.0, (step + 1) / 60) * (1 - passed) ** 0.8
        images = draw_images(renders, photos, batch, random).to(device)
        shape = (batch, config.latent_channels, images.shape[-2] // 8, images.shape[-1] // 8)
        with torch.autocast(device.type, torch.bfloat16):
            loss, record = autoencoder_loss(model, images, torch.randn(shape, generator=random).to(device))
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimizer.step()
        step += 1
        passed = (time.monotonic() - start) / seconds
        report(min(passed, 1.0), step, record["psnr"])
    enough = max(16, min(512, 2**23 // renders[0, 0].numel()))  # they pass through the encoder at once
    model.calibrate(draw_images(renders, photos, enough, generator(seed, "calibration")).to(device))
    return model.cpu().eval().requires_grad_(False)


def refine_decoder(
    autoencoder: Autoencoder,
    renders: Tensor,
    photos: Tensor | None,
    seconds: float,
    perceptual: PerceptualDistance,
    weight: float = 0.3,
    batch: int = 16,
    learning_rate: float = 1e-3,
    seed: int = 0,
    report: Callable[[float, float, float], None] = lambda passed, l1, distance: None,
) -> Autoencoder:
    """A copy whose decoder was trained for `seconds` more, on L1 and `weight` times the perceptual distance (Rombach et
    al. 2022, without the adversary). The encoder stays, so latents, banks and denoisers keep their meaning.

    renders and photos as in `train_autoencoder`, on the CPU. `report(share of time passed, L1, distance of the step)`.
    """
    model = copy.deepcopy(autoencoder).requires_grad_(False)
    model.decoder.requires_grad_(True)
    model.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    optimizer = torch.optim.AdamW(model.decoder.parameters(), lr=learning_rate, betas=(0.9, 0.99), weight_decay=1e-3)
    start, step, passed = time.monotonic(), 0, 0.0
    while passed < 1:
        random = generator(seed, "refine", step)
        optimizer.param_groups[0]["lr"] = learning_rate * min(1.0, (step + 1) / 30) * (1 - passed) ** 0.8
        images = draw_images(renders, photos, batch, random)
        with torch.autocast("cpu", torch.bfloat16):
            with torch.no_grad():
                raw, _ = model.posterior(images)
            decoded = model.decode_raw(raw).float()
        pixels = (decoded - images).abs().mean()
        distance = perceptual(decoded.clamp(0, 1), images).mean()
        optimizer.zero_grad(set_to_none=True)
        (pixels + weight * distance).backward()
        torch.nn.utils.clip_grad_norm_(model.decoder.parameters(), 1.0)
        optimizer.step()
        step, passed = step + 1, (time.monotonic() - start) / seconds
        report(min(passed, 1.0), pixels.item(), distance.item())
    model.to(memory_format=torch.contiguous_format)  # type: ignore[call-overload]
    return model.eval().requires_grad_(False)


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
