"""Benchmarks of the splats: the rasteriser against plain torch, splats against the field that they were made of, and
both reconstructors on the same views."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from cat3d_core.cameras import Cameras
from cat3d_core.metrics.perceptual import find_perceptual
from cat3d_core.metrics.protocols import evaluate
from cat3d_core.normalization import Similarity
from cat3d_core.reconstruction import ReconstructionRequest, Reconstructor, Render, Views
from cat3d_core.splats import Gaussians, rasterize_cpu, reference, render
from cat3d_core.splats.viewpoints import between
from cat3d_core.synthetic.families import FAMILIES
from flows.bench import counts, limits
from flows.bench.reconstruct import procedural_views
from flows.bench.scenes import DOWNSCALE, scene_views
from flows.exports.splats import splats_of, write_splats
from flows.progress import meter
from flows.reconstruction.open import reconstructor_class

PROTOCOL = "google"
HERE = Similarity(1.0, torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))
#: Gaussians and side of the image of `kernel_rows`; the reference takes memory for every pixel times every Gaussian.
WORKLOADS = ((1_000, 32), (4_000, 64), (20_000, 64), (20_000, 128), (200_000, 720))
REFERENCE_PAIRS = 20_000_000


def kernel_rows(repeats: int = 3, threads: Sequence[int] = (1, 2)) -> list[dict[str, Any]]:
    """Seconds of a step's forward and backward pass, by processor time, the best of `repeats`, and the share
    of the machine's limits that the two together reach (`limits`)."""
    rows = []
    before = torch.get_num_threads()
    try:
        for number in threads:
            torch.set_num_threads(number)
            for count, side in WORKLOADS:
                found = {"C++ kernel": _pass(rasterize_cpu.rasterize, count, side, repeats)}
                if count * side * side <= REFERENCE_PAIRS:
                    found["torch reference"] = _pass(reference.rasterize, count, side, 1)
                work = _work(count, side)
                for name, (forward, backward) in found.items():
                    row = {"rasteriser": name, "gaussians": count, "side": side, "threads": number}
                    row |= {"forward_ms": forward * 1e3, "backward_ms": backward * 1e3}
                    row |= limits.columns(work, forward + backward, "cpu")
                    if "torch reference" in found:
                        row["ratio"] = sum(found["torch reference"]) / (forward + backward)
                    rows.append(row)
    finally:
        torch.set_num_threads(before)
    return rows


def _inputs(count: int, side: int) -> tuple[list[Tensor], Cameras]:
    generator = torch.Generator().manual_seed(0)
    # As many pixels wide that each pixel is covered some ten times.
    width = 1.5 * (1.0 / count) ** 0.5
    inputs = [
        torch.randn((count, 3), generator=generator) * 0.5, torch.randn((count, 4), generator=generator),
        width * torch.exp(torch.randn((count, 3), generator=generator) * 0.5), torch.rand(count, generator=generator),
        torch.rand((count, 3), generator=generator),
    ]  # fmt: skip
    pose = torch.eye(4)[None].clone()
    pose[0, 2, 3] = -2.0
    k = torch.tensor([[[float(side), 0, side / 2], [0, float(side), side / 2], [0, 0, 1]]])
    return inputs, Cameras(k, pose, torch.tensor([[side, side]]))


def _work(count: int, side: int) -> limits.Work:
    inputs, camera = _inputs(count, side)
    return counts.rasterization(inputs, camera) + counts.rasterization(inputs, camera, "backward")


def _pass(draw: Any, count: int, side: int, repeats: int) -> tuple[float, float]:
    inputs, camera = _inputs(count, side)
    inputs = [value.requires_grad_() for value in inputs]
    best = [float("inf")] * 2
    for _ in range(repeats):
        started = time.process_time()
        raster = draw(*inputs, camera)
        middle = time.process_time()
        (raster.features.sum() + raster.opacity.sum()).backward()
        best = [min(best[0], middle - started), min(best[1], time.process_time() - middle)]
    return best[0], best[1]


Named = tuple[str, Views, Views]  # a scene's name, training and held-out views


def procedural_scenes(families: Sequence[str] = tuple(FAMILIES), size: int = 64) -> Iterator[Named]:
    """24 training and 4 held-out views of each family."""
    for family in families:
        yield family, *procedural_views(family, 24, 4, size, size)[:2]


def captured_scenes(folders: Sequence[Path]) -> Iterator[Named]:
    """All training and held-out views of captured scenes, about 100 pixels large."""
    for folder in folders:
        yield folder.name, *scene_views(folder, "all", DOWNSCALE[folder.name])


def conversion_rows(scenes: Iterable[Named], steps: int = 500, most_views: int = 72) -> list[dict[str, Any]]:
    """Splats against the field (preset fast) that they were made of, on held-out views, without and with refinement;
    seconds are those of one processor core."""
    rows = []
    for name, views, held in scenes:
        field, seconds = trained("zipnerf", "fast", views, 0)
        cameras = between(views.cameras, most_views)
        started = time.process_time()
        shown = [field.render(cameras, i) for i in range(len(cameras))]
        rendering = time.process_time() - started
        wanted = [field.render(held.cameras, i) for i in range(len(held))]
        common = {"scene": name, "field_cpu_s": seconds, "render_cpu_s": rendering,
                  "field_psnr_db": _psnr(wanted, held)}  # fmt: skip
        for refinement in (0, steps):
            started = time.process_time()
            splats = splats_of(field, shown, cameras, steps=refinement)
            used = time.process_time() - started
            images = [render(splats, held.cameras, i) for i in range(len(held))]
            rows.append(
                common | {"refinement": refinement, "splats": len(splats), "cpu_s": used,
                          "psnr_to_field_db": _mean_psnr([r.image for r in images], [r.image for r in wanted]),
                          "psnr_db": _psnr(images, held)} | _megabytes(splats)
            )  # fmt: skip
    return rows


def _megabytes(splats: Gaussians) -> dict[str, float]:
    with tempfile.TemporaryDirectory() as folder:
        files, _ = write_splats(Path(folder), splats, HERE)
        return {f"mb_{file.suffix[1:]}": file.stat().st_size / 1e6 for file in files}


def method_rows(
    families: Sequence[str] = tuple(FAMILIES), counts: Sequence[int] = (3, 6, 9), seeds: Sequence[int] = (0, 1, 2),
    presets: Sequence[tuple[str, str]] = (("zipnerf", "fast"), ("splats", "fast")), test: int = 4, size: int = 64,
) -> list[dict[str, Any]]:  # fmt: skip
    """Each reconstructor from few captured views of each family: means over the held-out views."""
    rows = []
    perceptual = find_perceptual()
    with meter("reconstructors", len(families) * len(counts) * len(seeds) * len(presets)) as progress:
        for family in families:
            for seed in seeds:
                views, held, _ = procedural_views(family, 3 * max(counts), test, size, size, seed)
                for count in counts:
                    kept = [round(i * (len(views) - 1) / (count - 1)) for i in range(count)]
                    some = Views.from_images(views.cameras[kept], [views.image(i) for i in kept], views.captured[kept])
                    for method, preset in presets:
                        scene, seconds = trained(method, preset, some, seed)
                        found = [
                            evaluate(PROTOCOL, scene.render(held.cameras, i).image.permute(2, 0, 1),
                                     held.image(i).permute(2, 0, 1) / 255, perceptual=perceptual)
                            for i in range(len(held))
                        ]  # fmt: skip
                        means = {name: sum(row[name] for row in found) / len(found) for name in found[0]}
                        rows.append({"family": family, "views": count, "seed": seed, "method": method,
                                     "preset": preset, "cpu_s": seconds} | means)  # fmt: skip
                        progress.advance(note=f"{method} {means['psnr']:.1f} dB")
    return rows


def trained(method: str, preset: str, views: Views, seed: int) -> tuple[Reconstructor, float]:
    """A reconstruction of captured views, and the processor seconds it took."""
    scene = reconstructor_class(method).from_request(ReconstructionRequest(preset))
    started = time.process_time()
    scene.start(views, seed, "cpu")
    while not scene.finished:
        scene.step()
    return scene, time.process_time() - started


def _mean_psnr(images: Sequence[Tensor], truths: Sequence[Tensor]) -> float:
    found = [-10 * (a - b).square().mean().log10() for a, b in zip(images, truths, strict=True)]
    return float(torch.stack(found).mean())


def _psnr(renders: Sequence[Render], views: Views) -> float:
    return _mean_psnr([r.image for r in renders], [views.image(i) / 255 for i in range(len(views))])
