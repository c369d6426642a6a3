"""A model's samples on held-out procedural and captured scenes, beside what they have to beat and what bounds them.

For each target view of a group of 8 (M conditioning views, 8 - M targets), against its exact render:
  sample       the model, given the conditioning views and all cameras
  nearest      the nearest conditioning view, copied (camera distance: position in scene units + angle in radians)
  warp         the conditioning views carried over by the target's true depth, nearest first; holes keep `nearest`
               (procedural scenes: captured ones have no true depth)
  autoencoder  encoded and decoded, without diffusion: the samples' ceiling
Scenes are seeded apart from the training scenes and use procedural textures only, so that everyone can run this.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from cat3d_core.cameras import Cameras
from cat3d_core.diffusion import SamplerConfig
from cat3d_core.generation import Generator, generate
from cat3d_core.generation.advice import FEW_STEPS, MANY_STEPS
from cat3d_core.metrics.perceptual import PerceptualDistance, find_perceptual
from cat3d_core.metrics.psnr import psnr
from cat3d_core.metrics.ssim import ssim
from cat3d_core.normalization import normalize_scene
from cat3d_core.random import normal
from cat3d_core.sample_sets import sample_cameras, source_boxes
from cat3d_core.synthetic import FAMILIES
from cat3d_core.synthetic.held_out import held_out_group
from cat3d_core.synthetic.tracer import Traced
from cat3d_core.view_selection import camera_distance, evenly
from cat3d_core.warp import warp
from flows.errors import InputError
from flows.generation.formats import cat3d
from flows.jobs.device import exact_device
from flows.media.images import read_image, square_image, write_png
from flows.readers.base import read_capture
from flows.training.hint_bank import told
from flows.training.worlds.held_out import HeldOutWorld, held_out_worlds

CAPTURED = ("llff_fern", "dtu_scan24", "co3d_apple", "re10k_bedroom", "mipnerf360_bonsai", "fox")
ALL_CAPTURED = "all captured"
WORLDS = "held-out worlds"
METHODS = ("sample", "nearest", "warp", "autoencoder")


def captured_group(scene: Path, size: int, given: int, views: int = 8) -> tuple[Tensor, Cameras]:
    """Square views (N, 3, size, size) in [0, 1] and normalised cameras of a captured scene: the training views of its
    few-view split, then as many of its test views as fit, evenly spaced. Lens distortion is left in.

    Raises InputError for a scene without known cameras."""
    capture = read_capture(scene)
    if capture.cameras is None:
        raise InputError(f"{scene} has no cameras; samples are compared with photographs from known ones.")
    split = capture.splits[str(given)]
    test = split["test"]
    chosen = [*split["train"], *(test[row] for row in evenly(len(test), views - given))]
    cameras = normalize_scene(capture.cameras, capture.points, capture.depth_bounds).cameras(capture.cameras)[chosen]
    boxes = source_boxes(cameras.size, "square").tolist()
    squares = [
        square_image(read_image(capture.paths[i], upright=capture.upright)[0], box, size)
        for i, box in zip(chosen, boxes, strict=True)
    ]
    images = torch.stack([torch.from_numpy(square).permute(2, 0, 1).float() / 255 for square in squares])
    return images, sample_cameras(cameras, "square", size)


def world_group(world: HeldOutWorld, size: int) -> tuple[Traced, Cameras]:
    """A held-out world at another size, as `held_out_group` gives a procedural scene."""
    image = F.interpolate(world.image, (size, size), mode="area")
    depth = F.interpolate(world.depth[:, None], (size, size))[:, 0]
    return Traced(image, depth, torch.zeros_like(image)), world.cameras.resize(size, size)


def evaluate_group(
    generator: Generator, image: Tensor, cameras: Cameras, given: int, sampler: SamplerConfig, key: tuple
) -> dict[str, Tensor]:
    """Images (N - given, 3, H, W) of each method but `warp`, and `truth`; image (N, 3, H, W), the first `given`
    given. A model that takes hints is given the shipped plane sweep's."""
    shape, truth = generator.spec.latent_shape, image[given:]
    (made,) = generate(
        generator, [(image[:given], cameras)], sampler, lambda _, view: normal(shape, 0, *key, view, "noise"),
        [told(generator, image[:given], cameras)],
    )  # fmt: skip
    nearest = image[camera_distance(cameras)[given:, :given].argmin(1)]
    return {"sample": made, "nearest": nearest, "autoencoder": generator.decode(generator.encode(truth)),
            "truth": truth}  # fmt: skip


def warped(traced: Traced, cameras: Cameras, given: int) -> Tensor:
    """Images (N - given, 3, H, W): the given views carried over by true depth, nearest first, holes as in the
    nearest."""
    order = camera_distance(cameras)[given:, :given].argsort(1)
    images = []
    for row, target in enumerate(range(given, len(cameras))):
        near = order[row].tolist()
        photos, depths = traced.image[near], traced.depth[near]
        image, seen = warp(list(photos), list(depths), cameras[near], cameras[target], traced.depth[target])
        images.append(torch.where(seen, image, traced.image[order[row, 0]]))
    return torch.stack(images)


def rows(
    generator: Generator,
    scenes_per_family: int = 20,
    conditions: tuple[int, ...] = (3, 1),
    sampler: SamplerConfig | None = None,
    perceptual: PerceptualDistance | None = None,
    pictures: Path | None = None,
    captured: Sequence[Path] = (),
    worlds: Path | None = None,
) -> list[dict[str, Any]]:
    """One row per family (and "all"), captured scene, the held-out worlds of a folder, number of conditioning views
    and method: mean PSNR, SSIM (gaussian, valid) and, where a network is given, its distance, over all target views.
    pictures: a folder for contact sheets."""
    sampler, size, views = sampler or FEW_STEPS, generator.spec.image_size[0], generator.spec.views
    scores: dict[tuple, list[dict[str, float]]] = defaultdict(list)

    def take(labels: tuple[str, ...], given: int, images: dict[str, Tensor]) -> None:
        truth = images["truth"]
        for method, image in images.items():
            if method == "truth":
                continue
            score = {"psnr": float(psnr(image, truth).mean()), "ssim": float(ssim(image, truth).mean())}
            if perceptual is not None:
                score[perceptual.name] = float(perceptual(image, truth).mean())
            for label in labels:
                scores[label, given, method].append(score)

    for family in FAMILIES:
        for number in range(scenes_per_family):
            traced, cameras = held_out_group(family, number, size, views)
            for given in conditions:
                images = evaluate_group(generator, traced.image, cameras, given, sampler, (family, number))
                images["warp"] = warped(traced, cameras, given)
                take((family, "all"), given, images)
                if pictures is not None and number < 3:
                    contact_sheet(pictures / f"{family}_{number}_{given}.png", traced.image[:given], images)
    for world in held_out_worlds(worlds, views) if worlds else ():
        traced, cameras = world_group(world, size)
        for given in conditions:
            images = evaluate_group(generator, traced.image, cameras, given, sampler, (world.name,))
            images["warp"] = warped(traced, cameras, given)
            take((WORLDS,), given, images)
            if pictures is not None:
                contact_sheet(pictures / f"world_{world.name}_{given}.png", traced.image[:given], images)
    for scene in captured:
        for given in conditions:
            image, cameras = captured_group(scene, size, given, views)
            images = evaluate_group(generator, image, cameras, given, sampler, (scene.name,))
            take((scene.name, ALL_CAPTURED), given, images)
            if pictures is not None:
                contact_sheet(pictures / f"{scene.name}_{given}.png", image[:given], images)
    out = []
    for (label, given, method), found in scores.items():
        means = {name: round(sum(s[name] for s in found) / len(found), 4) for name in found[0]}
        out.append({"family": label, "condition_views": given, "method": method, "scenes": len(found), **means})
    return out


def table(result: list[dict[str, Any]], metric: str = "psnr") -> str:
    """Markdown: a line per number of conditioning views and family or scene, a column per method."""
    methods = ("nearest", "sample", "warp", "autoencoder")
    lines = [f"| {metric}, given | scenes | " + " | ".join(methods) + " |", "|---|---|" + "---|" * len(methods)]
    value = {(r["family"], r["condition_views"], r["method"]): r[metric] for r in result}
    for given in sorted({r["condition_views"] for r in result}, reverse=True):
        for label in dict.fromkeys(
            r["family"] for r in sorted(result, key=lambda r: r["family"] in ("all", ALL_CAPTURED))
        ):
            cells = " | ".join(f"{value[label, given, m]:.2f}" if (label, given, m) in value else "" for m in methods)
            lines.append(f"| {given} | {label} | {cells} |")
    return "\n".join(lines)


def contact_sheet(path: Path, given: Tensor, images: dict[str, Tensor], names: Sequence[str] = METHODS) -> None:
    """A PNG, twice as large: the given views and the truth in the first line, then a line per name that there is of.

    given (M, 3, H, W) and images (N, 3, H, W) in [0, 1], `truth` among them."""
    path.parent.mkdir(parents=True, exist_ok=True)
    blank = torch.ones(len(given), *given.shape[1:])
    shown = [name for name in names if name in images]
    lines = [torch.cat([given, images["truth"]])] + [torch.cat([blank, images[name]]) for name in shown]
    sheet = torch.cat([torch.cat(list(line), -1) for line in lines], -2)
    write_png(path, F.interpolate(sheet[None], scale_factor=2, mode="nearest")[0].permute(1, 2, 0))


def captured_scenes(data: Path | None) -> list[Path]:
    """One captured scene of each family the paper evaluates on, as far as `data` has them."""
    return [] if data is None else [data / name for name in CAPTURED if (data / name).is_dir()]


def evaluate_file(
    path: Path,
    scenes: int,
    sampler: SamplerConfig = FEW_STEPS,
    pictures: Path | None = None,
    data: Path | None = None,
    worlds: Path | None = None,
) -> str:
    """Markdown tables of PSNR, SSIM and (where weights are found) perceptual distance of a model file."""
    perceptual = find_perceptual()
    generator = cat3d.load(path, exact_device(), "bfloat16")
    result = rows(
        generator, scenes, sampler=sampler, perceptual=perceptual, pictures=pictures,
        captured=captured_scenes(data), worlds=worlds,
    )  # fmt: skip
    return "\n\n".join(table(result, m) for m in ("psnr", "ssim", *([perceptual.name] if perceptual else [])))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", type=Path, help="a model file (safetensors)")
    parser.add_argument("--scenes", type=int, default=20, help="held-out scenes per family")
    parser.add_argument("--many-steps", action="store_true", help="UniPC with 20 steps instead of DDIM with 4")
    parser.add_argument("--pictures", type=Path)
    parser.add_argument("--data", type=Path, help=f"folder with captured scenes: {', '.join(CAPTURED)}")
    parser.add_argument("--worlds", type=Path, help="folder of held-out worlds (cat3d worlds PACKAGE --held-out DIR)")
    options = parser.parse_args()
    torch.set_num_threads(1)
    sampler = MANY_STEPS if options.many_steps else FEW_STEPS
    print(evaluate_file(options.model, options.scenes, sampler, options.pictures, options.data, options.worlds))


if __name__ == "__main__":
    main()
