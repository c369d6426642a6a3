"""The bank of latents on disk: encoded once from the renders, read whole into memory."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from safetensors.torch import load_file
from torch import Tensor

from cat3d_core.diffusion import Autoencoder, LatentBank
from cat3d_core.diffusion.hints import rescaled
from flows.training.renders import as_tensors, save, shards, variants


@torch.no_grad()
def encode_shards(
    folder: Path, autoencoder: Autoencoder, count: int, device: torch.device | str, mine: Sequence[int],
    advance: Callable[[int], None],
) -> None:  # fmt: skip
    """Latents of the rendered shards `mine` that have none yet, in `count` variants of each scene."""
    autoencoder = autoencoder.to(device).eval()
    for number in mine:
        source = folder / "renders" / f"{number:05d}.safetensors"
        target = folder / "latents" / source.name
        if not target.exists():
            shard, parts, family = load_file(source), [], []
            for scene in range(len(shard["family"])):
                for capture in variants(shard, scene, source.name, count):
                    latents = autoencoder.encode(capture.image.to(device)).cpu().half()
                    parts.append({"latents": latents, **{k: t for k, t in as_tensors(capture).items() if k != "image"}})
                    family.append(shard["family"][scene])
            stacked = {name: torch.stack([p[name] for p in parts]) for name in parts[0]}
            save(target, stacked | {"family": torch.stack(family)})
        advance(1)


def load_bank(folder: Path, image_size: int) -> LatentBank:
    """All latents of a folder. Raises ValueError where there are none."""
    parts = [load_file(path) for path in shards(folder, "latents")]
    if not parts:
        raise ValueError(f"{folder / 'latents'} holds no latents; encode the renders first.")
    return LatentBank(**{name: torch.cat([p[name] for p in parts]) for name in parts[0]}, image_size=image_size)


def jitter_scale(
    cameras: Tensor, most: float, random: torch.Generator, hints: Tensor | None = None
) -> tuple[Tensor, Tensor | None]:
    """Scale each group's scene by a number from 1 / most to most: the positions of its cameras [G, V, 4, 4], and the
    inverse depths of its hints."""
    factor = most ** (2 * torch.rand(len(cameras), 1, 1, generator=random) - 1)
    scaled = cameras.clone()
    scaled[:, :, :3, 3] *= factor
    return scaled, None if hints is None else rescaled(hints, factor.flatten())
