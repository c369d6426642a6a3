"""The pictures of a training: procedural scenes, rendered once into shards; and the photographs of their textures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import torch
import torch.nn.functional as F
from safetensors.torch import load_file, save_file
from torch import Tensor

from cat3d_core.cameras import Cameras
from cat3d_core.random import derive_seed, generator
from cat3d_core.synthetic.dataset import Capture, mirrored, recoloured, training_capture

SHARD_SCENES = 25
ATTEMPTS = 10


def save(path: Path, tensors: dict[str, Tensor]) -> None:
    """Write under the final name only when complete."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_suffix(".partial")
    save_file({k: t.contiguous() for k, t in tensors.items()}, partial)
    partial.replace(path)


def shards(folder: Path, kind: str) -> list[Path]:
    """Files of a kind (`renders`, `latents`) in order."""
    return sorted((folder / kind).glob("*.safetensors"))


def shard_numbers(scenes: int) -> range:
    """Shard n holds the scenes from n * SHARD_SCENES on."""
    return range(-(-scenes // SHARD_SCENES))


def bank_bytes(scenes: int, views: int, size: int, variants: int, channels: int) -> int:
    """Disk that renders (uint8) and latents (float16) of a bank take, cameras left out."""
    return scenes * views * (3 * size**2 + variants * 2 * channels * (size // 8) ** 2)


def squares(images: Sequence[Tensor], side: int = 448) -> Tensor:
    """Centre squares (M, 3, side, side) float in [0, 1] of photographs (3, H, W) uint8."""
    out = []
    for image in images:
        cut = min(image.shape[-2:])
        top, left = (image.shape[-2] - cut) // 2, (image.shape[-1] - cut) // 2
        window = image[None, :, top : top + cut, left : left + cut].float() / 255
        out.append(F.interpolate(window, (side, side), mode="bilinear", antialias=True).clamp(0, 1))
    return torch.cat(out)


def as_tensors(capture: Capture) -> dict[str, Tensor]:
    """A capture as it is stored: image uint8, cameras float32, and inverse depth float16 if it has one."""
    depth = {} if capture.inverse_depth is None else {"inverse_depth": capture.inverse_depth.half()}
    return depth | {
        "image": (capture.image * 255).round().to(torch.uint8),
        "intrinsics": capture.cameras.intrinsics.float(),
        "world_from_camera": capture.cameras.world_from_camera.float(),
    }


def training_scene(
    family: str, number: int, seed: int, views: int, size: int, textures: Tensor | None,
    device: torch.device | str, with_depth: bool = False,
) -> Capture:  # fmt: skip
    """Training scene `number`. Raises ValueError where ten draws of it have no free place for cameras."""
    for attempt in range(ATTEMPTS):
        try:
            key = derive_seed(seed, "training scene", number, attempt) & 0x7FFFFFFF
            return training_capture(family, key, views, size, textures, device, with_depth)
        except ValueError:  # no free place for the cameras: the next draw
            if attempt == ATTEMPTS - 1:
                raise
    raise AssertionError


def render_shards(
    folder: Path,
    families: Sequence[str],
    scenes: int,
    views: int,
    size: int,
    seed: int,
    textures: Tensor | None,
    device: torch.device | str,
    mine: Sequence[int],
    advance: Callable[[int], None],
    with_depth: bool = False,
) -> None:
    """Render the shards `mine` that are not there yet, families in turn. `advance` is called with numbers of scenes."""
    for shard in mine:
        path = folder / "renders" / f"{shard:05d}.safetensors"
        numbers = range(shard * SHARD_SCENES, min((shard + 1) * SHARD_SCENES, scenes))
        if path.exists():
            advance(len(numbers))
            continue
        parts = []
        for number in numbers:
            family = families[number % len(families)]
            parts.append(as_tensors(training_scene(family, number, seed, views, size, textures, device, with_depth)))
            advance(1)
        stacked = {name: torch.stack([p[name] for p in parts]) for name in parts[0]}
        stacked["family"] = torch.tensor([number % len(families) for number in numbers])
        save(path, stacked)


def variants(shard: dict[str, Tensor], scene: int, name: str, count: int) -> list[Capture]:
    """Scene number `scene` of a shard as rendered, recoloured and mirrored, and recoloured: the first `count`."""
    image, k, pose = (shard[key][scene] for key in ("image", "intrinsics", "world_from_camera"))
    size = torch.tensor([image.shape[-1], image.shape[-2]]).repeat(len(image), 1)
    capture = Capture(image.float() / 255, Cameras(k, pose, size))
    random = generator(scene, "variant", name)
    return [capture, mirrored(recoloured(capture, random)), recoloured(capture, random)][:count]


def rendered_images(folder: Path, at_most: int) -> Tensor:
    """Images (B, 3, H, W) uint8 of the first shards, about `at_most` of them."""
    parts: list[Tensor] = []
    for path in shards(folder, "renders"):
        parts.append(load_file(path)["image"].flatten(0, 1))
        if sum(map(len, parts)) >= at_most:
            break
    return torch.cat(parts)
