"""Groups of rendered scenes with predicted hints: what the plane sweep of some views says of the others.

Predicted once and kept, since the sweep takes longer than a step of the training that it is for. Given views suffer
what photos suffer, as in the sweep's own training (`flows/training/sweep_batches.py`)."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from safetensors.torch import load_file
from torch import Tensor

from cat3d_core.cameras import Cameras
from cat3d_core.diffusion import Autoencoder
from cat3d_core.diffusion.hint_bank import HintBank
from cat3d_core.diffusion.hints import hint_latents
from cat3d_core.generation import Generator
from cat3d_core.matching.checkpoint import load_sweep
from cat3d_core.matching.hint import hint, observe
from cat3d_core.matching.network import SweepNetwork
from cat3d_core.random import generator
from cat3d_core.weights import default_sweep_path
from flows.training.renders import save, shards
from flows.training.sweep_batches import augmented, cameras_of, chosen, misplaced, photographed, prepared

#: First shards of other folders that are left out: trainings of the sweep hold them out as well.
HELD = 1
#: Least share of a scene's cameras, nearest first, that a group is drawn from.
_NARROWEST = 0.6


def sources(folder: Path, others: Sequence[Path]) -> list[tuple[str, Path]]:
    """The shards of renders to predict for, each with the name of its result."""
    found = [(f"0_{path.name}", path) for path in shards(folder, "renders")]
    for number, other in enumerate(others, 1):
        found += [(f"{number}_{path.name}", path) for path in shards(other, "renders")[HELD:]]
    return found


def predict_shards(
    folder: Path, tasks: Sequence[tuple[str, Path]], network: SweepNetwork, autoencoder: Autoencoder,
    given: Sequence[int], views: int, size: int, seed: int, advance: Callable[[int], None],
) -> None:  # fmt: skip
    """folder/hints/NAME for each task that has none: a group of each scene for each number of given views."""
    for name, path in tasks:
        target = folder / "hints" / name
        if not target.exists():
            shard, parts = load_file(path), []
            for number in range(len(shard["family"])):
                raw = {k: t[number] for k, t in shard.items() if k != "family"}
                if len(raw["image"]) < views:
                    continue
                for m in dict.fromkeys(given):
                    random = generator(seed, "hints", name, number, m)
                    parts.append(hinted_group(raw, network, autoencoder, m, views, size, random))
                    parts[-1]["family"] = shard["family"][number]
            if parts:
                save(target, {key: torch.stack([part[key] for part in parts]) for key in parts[0]})
        advance(1)


@torch.no_grad()
def hinted_group(
    raw: dict[str, Tensor], network: SweepNetwork, autoencoder: Autoencoder, given: int, views: int, size: int,
    random: torch.Generator,
) -> dict[str, Tensor]:  # fmt: skip
    """One group of a scene (image, intrinsics, world_from_camera) as HintBank holds it."""
    spread = _NARROWEST + (1 - _NARROWEST) * float(torch.rand((), generator=random))
    unknown = torch.zeros(*raw["image"].shape[:1], *raw["image"].shape[-2:])  # depths are for the sweep's own training
    drawn = chosen({"inverse_depth": unknown} | raw, views, spread, random)
    scene = augmented(prepared(drawn, size, random), random)
    cameras = cameras_of(misplaced(scene.views, random), size)
    photos = photographed(scene.image[:given], random)
    device = autoencoder.latent_std.device
    with torch.autocast(device.type, torch.bfloat16):
        observed = observe(network, photos, cameras[slice(0, given)])
        found = hint(network, observed, cameras[slice(given, None)])
    latents = autoencoder.encode(torch.cat([photos, scene.image[given:]]).to(device)).cpu()
    hints = hint_latents(autoencoder, vars(found)).cpu()
    hints = torch.cat([hints.new_zeros(given, *hints.shape[1:]), hints])
    return {
        "latents": latents.half(), "hints": hints.half(), "intrinsics": cameras.intrinsics.float(),
        "world_from_camera": cameras.world_from_camera.float(), "given": torch.tensor(given),
    }  # fmt: skip


@functools.lru_cache(maxsize=1)
def shipped_sweep() -> SweepNetwork:
    """The shipped plane sweep, on the CPU."""
    return load_sweep(default_sweep_path())


def told(model: Generator, image: Tensor, cameras: Cameras) -> dict[str, Tensor]:
    """For a model that takes hints: what the shipped plane sweep of the given views, image (M, 3, H, W), the first
    of the cameras, says of the others. Nothing for other models."""
    if "hints" not in model.spec.wants:
        return {}
    given = len(image)
    with torch.no_grad(), torch.autocast("cpu", torch.bfloat16):
        observed = observe(shipped_sweep(), image, cameras[slice(0, given)])
        return vars(hint(shipped_sweep(), observed, cameras[slice(given, None)]))


def load_hint_bank(folder: Path, image_size: int) -> HintBank:
    """All groups of a folder. Raises ValueError where there are none."""
    parts = [load_file(path) for path in shards(folder, "hints")]
    if not parts:
        raise ValueError(f"{folder / 'hints'} holds no groups; predict the hints first.")
    return HintBank(**{name: torch.cat([p[name] for p in parts]) for name in parts[0]}, image_size=image_size)
