"""The plane sweep on the scenes of `flows/training/evaluation.py`: held-out procedural scenes, worlds, captured ones.

For each target view of a group of 8 (M given, 8 - M targets), against its exact render or photograph:
  nearest      the nearest given view, copied
  sample       the shipped diffusion model's sample
  sweep        what the photos show of it, as the plane sweep finds it
  composite    the sweep where it is confident, the sample elsewhere
  warp         the given views carried over by the target's true depth; holes keep `nearest` (not for captured ones)
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import json
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file
from torch import Tensor

from cat3d_core.cameras import Cameras
from cat3d_core.diffusion import SamplerConfig
from cat3d_core.generation import Cat3dGenerator, generate
from cat3d_core.generation.advice import FEW_STEPS
from cat3d_core.matching.checkpoint import load_sweep
from cat3d_core.matching.composite import Composite
from cat3d_core.matching.hint import Hint, hint, observe
from cat3d_core.matching.network import SweepNetwork
from cat3d_core.metrics.perceptual import PerceptualDistance, find_perceptual
from cat3d_core.metrics.psnr import psnr
from cat3d_core.metrics.ssim import ssim
from cat3d_core.random import normal
from cat3d_core.synthetic import FAMILIES
from cat3d_core.synthetic.held_out import held_out_group
from cat3d_core.view_selection import camera_distance
from cat3d_core.warp import warp
from cat3d_core.weights import default_model_path
from flows.generation.formats import cat3d
from flows.training.evaluation import (
    ALL_CAPTURED,
    WORLDS,
    captured_group,
    captured_scenes,
    contact_sheet,
    evaluate_group,
    warped,
    world_group,
)
from flows.training.renders import save
from flows.training.worlds.held_out import HeldOutWorld, held_out_worlds

SIZE, VIEWS = 128, 8
METHODS = ("nearest", "sample", "sweep", "composite", "warp")
SHOWN = ("nearest", "warp", "sample", "sweep", "composite", "confidence")


@dataclass(frozen=True)
class Case:
    """One group: its name, the labels it counts under, `given` views of image (V, 3, H, W), normalised cameras,
    pictures (V - given, 3, H, W) of methods that need no sweep, and the targets' inverse depth where it is known."""

    name: str
    labels: tuple[str, ...]
    given: int
    image: Tensor
    cameras: Cameras
    pictures: dict[str, Tensor]
    inverse_depth: Tensor | None


def cases(
    cache: Path, scenes: int, given: Sequence[int], data: Path | None, worlds: Path | None = None, groups: int = 0
) -> Iterator[Case]:
    """Procedural scenes of each family, captured ones, and the first groups of held-out worlds (fewer where there are
    fewer). What takes long is kept in `cache`."""
    for number in range(scenes):
        for family in FAMILIES:
            for m in given:
                stored = _procedural(cache / f"{family}_{number:03d}_{m}.safetensors", family, number, m)
                yield case(f"{family}_{number}", (family, "all"), m, stored)
    for scene in captured_scenes(data):
        for m in given:
            stored = _captured(cache / f"{scene.name}_{m}.safetensors", scene, m)
            yield case(scene.name, (scene.name, ALL_CAPTURED), m, stored)
    for world in islice(held_out_worlds(worlds, VIEWS), groups) if worlds else ():
        for m in given:
            yield case(world.name, (WORLDS,), m, _world(cache / f"world_{world.name}_{m}.safetensors", world, m))


def case(name: str, labels: tuple[str, ...], given: int, stored: dict[str, Tensor]) -> Case:
    """A group as it is kept in the cache (`sampled`)."""
    stored = dict(stored)
    image = stored.pop("image")
    size = torch.tensor([[image.shape[-1], image.shape[-2]]]).repeat(len(image), 1)
    cameras = Cameras(stored.pop("intrinsics"), stored.pop("world_from_camera"), size)
    depth = stored.pop("inverse_depth", None)
    return Case(name, labels, given, image, cameras, {k: t.float() for k, t in stored.items()}, depth)


@functools.lru_cache(maxsize=1)
def model() -> Cat3dGenerator:
    """The shipped diffusion model, loaded when it is first needed."""
    return cat3d.load(default_model_path(), "cpu", "bfloat16")


def sampled(image: Tensor, cameras: Cameras, given: int, key: tuple) -> dict[str, Tensor]:
    """`sample`, with the shipped model and without hints, and `nearest`."""
    images = evaluate_group(model(), image, cameras, given, FEW_STEPS, key)
    return {name: images[name].half() for name in ("sample", "nearest")} | {
        "image": image, "intrinsics": cameras.intrinsics, "world_from_camera": cameras.world_from_camera,
    }  # fmt: skip


def hinted_sample(generator: Cat3dGenerator, case: Case, found: Hint, sampler: SamplerConfig = FEW_STEPS) -> Tensor:
    """A sample of the targets (N, 3, H, W) by a model that takes hints; `case`'s own for one that doesn't."""
    if "hints" not in generator.spec.wants:
        return case.pictures["sample"]
    shape = generator.spec.latent_shape
    (made,) = generate(
        generator, [(case.image[: case.given], case.cameras)], sampler,
        lambda _, view: normal(shape, 0, case.name, view, "noise"), [vars(found)],
    )  # fmt: skip
    return made


def _procedural(path: Path, family: str, number: int, given: int) -> dict[str, Tensor]:
    if not path.exists():
        traced, cameras = held_out_group(family, number, SIZE, VIEWS)
        parts = sampled(traced.image, cameras, given, (family, number))
        save(path, parts | {"warp": warped(traced, cameras, given).half(), "inverse_depth": 1 / traced.depth[given:]})
    return load_file(path)


def _world(path: Path, world: HeldOutWorld, given: int) -> dict[str, Tensor]:
    if not path.exists():
        traced, cameras = world_group(world, SIZE)
        parts = sampled(traced.image, cameras, given, (world.name,))
        save(path, parts | {"warp": warped(traced, cameras, given).half(), "inverse_depth": 1 / traced.depth[given:]})
    return load_file(path)


def _captured(path: Path, scene: Path, given: int) -> dict[str, Tensor]:
    if not path.exists():
        image, cameras = captured_group(scene, SIZE, given, VIEWS)
        save(path, sampled(image, cameras, given, (scene.name,)))
    return load_file(path)


def swept(network: SweepNetwork, case: Case) -> Hint:
    """What the given views show of the others."""
    with torch.no_grad(), torch.autocast("cpu", torch.bfloat16):
        observed = observe(network, case.image[: case.given], case.cameras[slice(0, case.given)])
        return hint(network, observed, case.cameras[slice(case.given, None)])


def scores(
    network: SweepNetwork, found: Iterator[Case], composite: Composite, perceptual: PerceptualDistance | None,
    pictures: Path | None = None, generator: Cat3dGenerator | None = None, sampler: SamplerConfig = FEW_STEPS,
) -> list[dict[str, Any]]:  # fmt: skip
    """One row per label, number of given views and method: means over groups of PSNR, SSIM and perceptual distance;
    over the pixels that the sweep is confident of (> 0.5) and over the others; how well targets agree (`disagreement`);
    with the method `sweep`, also the error of inverse depth and seconds of the processor a view.

    generator: makes the samples, if it takes hints. pictures: a folder for a contact sheet of each group."""
    rows: dict[tuple[str, int, str], list[dict[str, float]]] = defaultdict(list)
    for case in found:
        started = time.process_time()
        h, truth = swept(network, case), case.image[case.given :]
        seconds = (time.process_time() - started) / len(truth)
        sample = case.pictures["sample"] if generator is None else hinted_sample(generator, case, h, sampler)
        images = case.pictures | {
            "sample": sample, "sweep": h.colour, "composite": composite(h.colour, h.confidence, sample),
        }  # fmt: skip
        if pictures is not None:
            shown = images | {"truth": truth, "confidence": h.confidence[:, None].expand(-1, 3, -1, -1)}
            contact_sheet(pictures / f"{case.name}_{case.given}.png", case.image[: case.given], shown, SHOWN)
        for method, picture in images.items():
            score = {"psnr": float(psnr(picture, truth).mean()), "ssim": float(ssim(picture, truth).mean())}
            if perceptual is not None:
                score[perceptual.name] = float(perceptual(picture, truth).mean())
            score |= _confident(picture, truth, h.confidence)
            if case.inverse_depth is not None and len(truth) > 1:
                score["disagreement"] = disagreement(picture, case.inverse_depth, case.cameras[slice(case.given, None)])
            if method == "sweep":
                score |= {"confidence": float(h.confidence.mean()), "cpu_s": seconds}
                score |= _calibration(picture, truth, h.confidence)
                if case.inverse_depth is not None:
                    score["depth_error"] = float((h.inverse_depth - case.inverse_depth).abs().mean())
            for label in case.labels:
                rows[label, case.given, method].append(score)
    out = []
    for (label, given, method), several in rows.items():
        names = dict.fromkeys(name for s in several for name in s)
        means = {n: round(_mean([s[n] for s in several if n in s]), 4) for n in names}
        out.append({"label": label, "given": given, "method": method, "groups": len(several), **means})
    return out


def _mean(values: Sequence[float]) -> float:
    return sum(values) / max(len(values), 1)


def disagreement(picture: Tensor, inverse_depth: Tensor, cameras: Cameras) -> float:
    """Mean absolute difference between N pictures (N, 3, H, W) of one scene and what the nearest other one shows of the
    same places, carried over by the true inverse depths (N, H, W)."""
    apart = camera_distance(cameras).fill_diagonal_(torch.inf)
    depth, found = 1 / inverse_depth.clamp_min(1e-6), []
    for i, j in enumerate(apart.argmin(1).tolist()):
        image, seen = warp([picture[j]], [depth[j]], cameras[[j]], cameras[i], depth[i])
        if seen.any():
            found.append(float((image - picture[i]).abs().mean(0)[seen.reshape(depth[i].shape)].mean()))
    return _mean(found)


def _confident(picture: Tensor, truth: Tensor, confidence: Tensor) -> dict[str, float]:
    """PSNR over the pixels that the sweep is confident of, and over the others, where there are some."""
    error = (picture.clamp(0, 1) - truth).square().mean(1)
    out = {}
    for name, mask in (("psnr_confident", confidence > 0.5), ("psnr_other", confidence <= 0.5)):
        if int(mask.sum()) > 64:
            out[name] = float(-10 * error[mask].mean().clamp(min=1e-8).log10())
    return out


def _calibration(picture: Tensor, truth: Tensor, confidence: Tensor) -> dict[str, float]:
    """Mean of what confidence foretells, exp(-error / 0.06), at low, middle and high confidence."""
    right = torch.exp(-(picture - truth).abs().mean(1) / 0.06)
    out = {}
    for name, low, high in (("low", 0.0, 1 / 3), ("middle", 1 / 3, 2 / 3), ("high", 2 / 3, 1.01)):
        mask = (confidence >= low) & (confidence < high)
        if int(mask.sum()) > 64:
            out[f"right_{name}"], out[f"said_{name}"] = float(right[mask].mean()), float(confidence[mask].mean())
    return out


def table(rows: list[dict[str, Any]], perceptual: str | None) -> str:
    """Markdown: a line per number of given views and label; PSNR / SSIM / perceptual distance of each method."""
    lines = ["| given | scenes | " + " | ".join(METHODS) + " |", "|---" * (len(METHODS) + 2) + "|"]
    at = {(r["label"], r["given"], r["method"]): r for r in rows}
    for given in sorted({r["given"] for r in rows}, reverse=True):
        for label in dict.fromkeys(r["label"] for r in sorted(rows, key=lambda r: r["label"].startswith("all"))):
            cells = []
            for method in METHODS:
                r = at.get((label, given, method))
                cells.append(
                    ""
                    if r is None
                    else f"{r['psnr']:.2f} / {r['ssim']:.2f}" + (f" / {r[perceptual]:.2f}" if perceptual else "")
                )
            lines.append(f"| {given} | {label} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("network", type=Path, nargs="?", help="the sweep's weights; none: only fill the cache")
    parser.add_argument("--model", type=Path, help="the diffusion model; none: the one shipped")
    parser.add_argument("--steps", type=int, default=FEW_STEPS.steps, help="of the sampler, for a model with hints")
    parser.add_argument("--start", choices=("noise", "hint"), default="noise", help="where such a model starts")
    parser.add_argument("--scenes", type=int, default=20, help="held-out scenes per family")
    parser.add_argument("--given", type=int, nargs="+", default=[3, 1])
    parser.add_argument("--data", type=Path, help="folder with captured scenes")
    parser.add_argument("--worlds", type=Path, help="folder of held-out worlds (cat3d worlds PACKAGE --held-out DIR)")
    parser.add_argument("--world-groups", type=int, default=60, help="of the held-out worlds, at most")
    parser.add_argument("--pictures", type=Path, help="a folder for a contact sheet of each group")
    parser.add_argument("--cache", type=Path, default=Path("outputs/bench_sweep"))
    parser.add_argument("--json", type=Path, help="where the rows go")
    parser.add_argument("--captured-only", action="store_true")
    options = parser.parse_args()
    torch.set_num_threads(1)
    options.cache.mkdir(parents=True, exist_ok=True)
    scenes = 0 if options.captured_only else options.scenes
    found = cases(options.cache, scenes, options.given, options.data, options.worlds, options.world_groups)
    if options.network is None:
        for _ in found:
            pass
        return
    network, perceptual = load_sweep(options.network), find_perceptual()
    generator = cat3d.load(options.model or default_model_path(), "cpu", "bfloat16")
    sampler = dataclasses.replace(FEW_STEPS, steps=options.steps, start=options.start)
    rows = scores(network, found, network.composite, perceptual, options.pictures, generator, sampler)
    if options.json:
        options.json.write_text(json.dumps(rows))
    print(table(rows, perceptual.name if perceptual else None))
    for r in rows:
        if r["label"].startswith("all") or r["label"] == WORLDS:
            print(json.dumps(r))


if __name__ == "__main__":
    main()
