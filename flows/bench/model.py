"""A model's samples on held-out procedural scenes, beside what they have to beat and what bounds them.

For each target view of a group of 8 (M conditioning views, 8 - M targets), against its exact render:
  sample       the model, given the conditioning views and all cameras
  nearest      the nearest conditioning view, copied (camera distance: position in scene units + angle in radians)
  warp         the conditioning views carried over by the target's true depth, nearest first; holes keep `nearest`
  autoencoder  encoded and decoded, without diffusion: the samples' ceiling
Scenes are seeded apart from the training scenes and use procedural textures only, so that everyone can run this.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from cat3d_core.cameras import Cameras
from cat3d_core.diffusion import GuidanceConfig, MultiViewModel, SamplerConfig, load_model, sample
from cat3d_core.metrics.perceptual import PerceptualDistance, find_perceptual
from cat3d_core.metrics.psnr import psnr
from cat3d_core.metrics.ssim import ssim
from cat3d_core.normalization import normalize_scene
from cat3d_core.random import derive_seed, generator, normal
from cat3d_core.rays import image_rays, raymap
from cat3d_core.synthetic import FAMILIES, random_cameras, random_scene, trace
from cat3d_core.synthetic.dataset import surface_points
from cat3d_core.synthetic.tracer import Traced

# A young model predicts well what its views have in common and badly the rest: its samples are best after few steps.
FEW_STEPS = SamplerConfig("ddim", "trailing", 4, GuidanceConfig(scale=1.0))
MANY_STEPS = SamplerConfig("unipc", "log_snr", 20, GuidanceConfig(scale=1.0))


def held_out_group(family: str, number: int, size: int, views: int = 8, spread: float = 0.7) -> tuple[Traced, Cameras]:
    """Views (N, ...) and normalised cameras of held-out scene `number`, in random order."""
    for attempt in range(10):
        seed = derive_seed(1, "held-out scene", family, number, attempt) & 0x7FFFFFFF
        scene = random_scene(family, seed)
        try:
            cameras = random_cameras(scene, seed, views, size, size, spread=spread)
        except ValueError:  # no free place for the cameras: the next seed
            continue
        cameras = cameras[torch.randperm(views, generator=generator(seed, "order"))]
        traced = trace(scene, cameras)
        similarity = normalize_scene(cameras, surface_points(traced.depth, cameras))
        # Depth in the unit of the normalised cameras.
        return traced._replace(depth=traced.depth * similarity.scale), similarity.cameras(cameras)
    raise ValueError(f"No cameras stand free in held-out scene {number} of family '{family}'.")


def camera_distance(cameras: Cameras) -> Tensor:
    """(N, N) distance between centres plus angle between viewing directions (radians)."""
    cosine = (cameras.forward @ cameras.forward.T).clamp(-1, 1)
    return torch.cdist(cameras.centers, cameras.centers) + torch.acos(cosine)


def warp(traced: Traced, cameras: Cameras, target: int, sources: list[int]) -> tuple[Tensor, Tensor]:
    """Carry `sources` (best first) into `target` by its true depth: image (3, H, W), seen (H, W) bool."""
    height, width = traced.depth.shape[-2:]
    depth = traced.depth[target].reshape(-1, 1).double()
    # The sky is far away, not nowhere.
    depth = torch.where(depth.isfinite(), depth, torch.full_like(depth, 1e4))
    rays = image_rays(cameras, target)
    image, seen = torch.zeros(3, height * width), torch.zeros(height * width, dtype=torch.bool)
    pixels, z = cameras.project(rays.origins + depth * rays.directions)
    for source in sources:
        grid = (pixels[source] / torch.tensor([width, height]) * 2 - 1).float()[None, :, None]
        there = torch.nan_to_num(traced.depth[source], posinf=1e4)[None, None]
        reached = F.grid_sample(there, grid, mode="nearest", align_corners=False)[0, 0, :, 0]
        visible = (
            (grid[0, :, 0].abs() <= 1).all(-1) & (z[source] > 0) & ((reached - z[source]).abs() < 0.03 * z[source])
        )
        colour = F.grid_sample(traced.image[source][None], grid, align_corners=False, padding_mode="border")[0, :, :, 0]
        new = visible & ~seen
        image[:, new], seen = colour[:, new], seen | visible
    return image.reshape(3, height, width), seen.reshape(height, width)


@torch.no_grad()
def evaluate_group(
    model: MultiViewModel, traced: Traced, cameras: Cameras, given: int, sampler: SamplerConfig, key: tuple
) -> dict[str, Tensor]:
    """Images (8 - given, 3, H, W) of each method, and `truth`."""
    count, targets = len(cameras), list(range(given, len(cameras)))
    latents = model.autoencoder.encode(traced.image)
    h, w = latents.shape[-2:]
    rays = raymap(cameras, cameras.world_from_camera[0], h, w).float()
    noise = torch.stack([normal(latents.shape[1:], 0, *key, view, "noise") for view in targets])
    out = sample(model, latents[None, :given], rays[None], noise[None], sampler)[0]
    distance = camera_distance(cameras)[given:, :given]
    order = distance.argsort(1)
    nearest = traced.image[order[:, 0]]
    warped = []
    for row, target in enumerate(targets):
        image, seen = warp(traced, cameras, target, order[row].tolist())
        warped.append(torch.where(seen, image, nearest[row]))
    images = {"sample": model.autoencoder.decode(out), "nearest": nearest, "warp": torch.stack(warped)}
    images |= {"autoencoder": model.autoencoder.decode(latents[given:]), "truth": traced.image[given:]}
    assert all(len(i) == count - given for i in images.values())
    return images


def rows(
    model: MultiViewModel,
    scenes_per_family: int = 20,
    conditions: tuple[int, ...] = (3, 1),
    sampler: SamplerConfig | None = None,
    perceptual: PerceptualDistance | None = None,
    pictures: Path | None = None,
) -> list[dict[str, Any]]:
    """One row per family (and "all"), number of conditioning views and method: mean PSNR, SSIM (gaussian, valid)
    and, where a network is given, its distance, over all target views of all scenes. pictures: a folder for contact
    sheets."""
    sampler = sampler or FEW_STEPS
    sums: dict[tuple, list[dict[str, float]]] = defaultdict(list)
    for family in FAMILIES:
        for number in range(scenes_per_family):
            traced, cameras = held_out_group(family, number, model.config.image_size, model.config.views)
            for given in conditions:
                images = evaluate_group(model, traced, cameras, given, sampler, (family, number))
                truth = images.pop("truth")
                for method, image in images.items():
                    score = {"psnr": float(psnr(image, truth).mean()), "ssim": float(ssim(image, truth).mean())}
                    if perceptual is not None:
                        score[perceptual.name] = float(perceptual(image, truth).mean())
                    for group in (family, "all"):
                        sums[group, given, method].append(score)
                if pictures is not None and number < 3:
                    _contact_sheet(pictures / f"{family}_{number}_{given}.png", traced.image[:given], truth, images)
    out = []
    for (family, given, method), scores in sums.items():
        means = {name: round(sum(s[name] for s in scores) / len(scores), 4) for name in scores[0]}
        out.append({"family": family, "condition_views": given, "method": method, "scenes": len(scores), **means})
    return out


def table(result: list[dict[str, Any]], metric: str = "psnr") -> str:
    """Markdown: a line per number of conditioning views and family, a column per method."""
    methods = ("nearest", "sample", "warp", "autoencoder")
    lines = [f"| {metric}, given | family | " + " | ".join(methods) + " |", "|---|---|" + "---|" * len(methods)]
    value = {(r["family"], r["condition_views"], r["method"]): r[metric] for r in result}
    for given in sorted({r["condition_views"] for r in result}, reverse=True):
        for family in (*FAMILIES, "all"):
            cells = " | ".join(f"{value[family, given, m]:.2f}" for m in methods)
            lines.append(f"| {given} | {family} | {cells} |")
    return "\n".join(lines)


def _contact_sheet(path: Path, given: Tensor, truth: Tensor, images: dict[str, Tensor]) -> None:
    from flows.images import write_png

    path.parent.mkdir(parents=True, exist_ok=True)
    columns = len(given) + len(truth)
    blank = torch.ones(len(given), *truth.shape[1:])
    lines = [torch.cat([given, truth])] + [torch.cat([blank, images[m]]) for m in ("sample", "nearest", "warp")]
    sheet = torch.cat([torch.cat(list(line[:columns]), -1) for line in lines], -2)
    write_png(path, F.interpolate(sheet[None], scale_factor=2, mode="nearest")[0].permute(1, 2, 0))


def evaluate_file(path: Path, scenes: int, sampler: SamplerConfig = FEW_STEPS, pictures: Path | None = None) -> str:
    """Markdown tables of PSNR, SSIM and (where weights are found) perceptual distance of a model file."""
    perceptual = find_perceptual()
    model = load_model(path)
    model.unet = model.unet.to(torch.bfloat16)
    result = rows(model, scenes, sampler=sampler, perceptual=perceptual, pictures=pictures)
    return "\n\n".join(table(result, m) for m in ("psnr", "ssim", *([perceptual.name] if perceptual else [])))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", type=Path, help="a model file (safetensors)")
    parser.add_argument("--scenes", type=int, default=20, help="held-out scenes per family")
    parser.add_argument("--many-steps", action="store_true", help="UniPC with 20 steps instead of DDIM with 4")
    parser.add_argument("--pictures", type=Path)
    options = parser.parse_args()
    torch.set_num_threads(1)
    print(
        evaluate_file(options.model, options.scenes, MANY_STEPS if options.many_steps else FEW_STEPS, options.pictures)
    )


if __name__ == "__main__":
    main()
