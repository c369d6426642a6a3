"""Benchmarks of the reconstruction: PSNR against seconds, and the hash grid kernels against each other.

Scenes are procedural (exact cameras and depth); every row says what was run and how long it took here.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import time
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from cat3d_core.normalization import normalize_scene
from cat3d_core.reconstruction import Render, Views
from cat3d_core.synthetic import random_cameras, random_scene, trace
from cat3d_core.zipnerf import PRESETS, Trainer, ZipNerfConfig, hash_grid_cpu, hash_grid_triton, render_image
from cat3d_core.zipnerf.grid_layout import GridLayout, make_layout
from cat3d_core.zipnerf.grid_reference import query_reference
from flows.bench import limits
from flows.bench.counts import FieldCount, grid_query
from flows.bench.limits import Work
from flows.progress import meter

Times = tuple[float, float]  # wall and processor seconds
Query = Callable[[Tensor, Tensor, Tensor, GridLayout], Tensor]

#: What `curves` varies, one at a time, around a preset.
VARIATIONS: dict[str, list[dict[str, Any]]] = {
    "iterations": [{"iterations": n, "warmup_iterations": n // 10} for n in (100, 300, 1000)],
    "samples": [{"samples": s} for s in ((16, 8), (32, 16), (64, 32))],
    "grid": [{"grid_log2_table": n} for n in (14, 16, 18)],
    "batch": [{"batch_rays": n} for n in (512, 1024, 2048)],
    "multisamples": [{"multisamples": n} for n in (3, 6)],
}


def procedural_views(
    family: str, train: int, test: int, width: int = 64, height: int = 64, seed: int = 0
) -> tuple[Views, Views, list[Tensor]]:
    """Training views, held-out views, and the held-out true z-depths (H, W), in the normalised scene."""
    scene = random_scene(family, seed)
    cameras = random_cameras(scene, seed, train + test, width, height)
    tracing = trace(scene, cameras)
    similarity = normalize_scene(cameras)
    normalised = similarity.cameras(cameras)
    images = [(view * 255).round().to(torch.uint8).permute(1, 2, 0).contiguous() for view in tracing.image.cpu()]
    depths = list(tracing.depth.float().cpu() * similarity.scale)
    # Held-out cameras spread over the capture.
    held = {round((i + 0.5) * (train + test) / test - 0.5) for i in range(test)}
    kept = [i for i in range(train + test) if i not in held]
    shown = sorted(held)

    def views(rows: list[int]) -> Views:
        return Views.from_images(normalised[rows], [images[i] for i in rows], torch.ones(len(rows), dtype=torch.bool))

    return views(kept), views(shown), [depths[i] for i in shown]


def train_and_measure(
    config: ZipNerfConfig, train: Views, test: Views, depths: list[Tensor], device: str = "cpu", seed: int = 0
) -> dict[str, Any]:
    """Train once: mean held-out PSNR (dB), absolute relative error of the median depth, wall and processor
    seconds, training rays/s, and the shares of the machine's limits that a step and a rendered view reach (`limits`;
    by processor time on a CPU)."""
    trainer = Trainer(config, train, seed, device)

    def train_all() -> None:
        while not trainer.finished:
            trainer.step()

    with FieldCount(trainer.field) as count:
        seconds, cpu_seconds = _timed(train_all, device)
    steps = trainer.iteration
    training = _share(count.steps(steps), (seconds / steps, cpu_seconds / steps), device)
    renders: list[Render] = []
    with FieldCount(trainer.field) as count:
        each = (render_image(trainer.field, test.cameras, index, config) for index in range(len(test)))
        wall, cpu = _timed(lambda: renders.extend(each), device)
    work = count.images(len(test), renders[0].depth.numel())
    rendering = _share(work, (wall / len(test), cpu / len(test)), device)
    errors, relative = [], []
    for index, out in enumerate(renders):
        truth = test.image(index).float() / 255
        errors.append(-10 * math.log10(float((out.image.cpu() - truth).square().mean())))
        seen = torch.isfinite(depths[index]) & (depths[index] > 0)
        relative.append(float(((out.depth.cpu() - depths[index]).abs() / depths[index])[seen].mean()))
    return {
        "psnr_db": sum(errors) / len(errors),
        "depth_abs_rel": sum(relative) / len(relative),
        "seconds": seconds,
        "cpu_seconds": cpu_seconds,
        "iterations": float(trainer.iteration),
        "rays_per_s": trainer.iteration * config.batch_rays / seconds,
        "skipped": float(trainer.skipped),
        **training,
        "render_share_of_limit": rendering["share_of_limit"],
    }


def curves(
    preset: str = "fast",
    families: Sequence[str] = ("mip360",),
    vary: Sequence[str] = tuple(VARIATIONS),
    train: int = 24,
    test: int = 4,
    size: int = 64,
    iterations: int | None = None,
    device: str = "cpu",
) -> list[dict[str, Any]]:
    """PSNR against seconds: the preset, then each setting of `vary` changed alone. One row per run."""
    base = PRESETS[preset]
    if iterations is not None:
        base = dataclasses.replace(base, iterations=iterations, warmup_iterations=iterations // 10)
    changes = [("preset", {}), *((key, value) for key in vary for value in VARIATIONS[key])]
    changes = [(key, value) for key, value in changes if not value or dataclasses.replace(base, **value) != base]
    rows = []
    with meter(f"{preset}, {', '.join(families)}", len(families) * len(changes)) as progress:
        for family in families:
            views, held, depths = procedural_views(family, train, test, size, size)
            for name, change in changes:
                shown = ", ".join(f"{k}={v}" for k, v in change.items())
                common = {"family": family, "preset": preset, "varied": name, "setting": shown, "device": device}
                measured = train_and_measure(dataclasses.replace(base, **change), views, held, depths, device)
                rows.append(common | measured)
                progress.advance(note=f"{measured['psnr_db']:.1f} dB")
    return rows


def _kernels(device: str) -> dict[str, Query]:
    found: dict[str, Query] = {"torch reference": query_reference}
    if device == "cpu" and hash_grid_cpu.available():
        found["C++ kernel"] = hash_grid_cpu.query
    if device == "cuda" and hash_grid_triton.available():
        found["Triton kernel"] = hash_grid_triton.query
    return found


def _copy_bandwidth(device: str) -> float:
    """Bytes per second of a large copy (read + write), the best of five."""
    source = torch.zeros(2**26, device=device)
    target = torch.empty_like(source)
    seconds = min(_timed(lambda: target.copy_(source), device)[0] for _ in range(5))
    return 2 * source.numel() * 4 / seconds


def _timed(run: Callable[[], Any], device: str) -> tuple[float, float]:
    """Wall seconds, and processor seconds of all threads."""
    started, used = time.perf_counter(), time.process_time()
    run()
    if device == "cuda":
        torch.cuda.synchronize()
    return time.perf_counter() - started, time.process_time() - used


#: Workloads of `kernels`: the sampling of one step of a preset, and the size of its tables (None: the preset's own).
WORKLOADS: tuple[tuple[str, int | None], ...] = (("fast", None), ("paper", 16))


def kernels(
    rays: int = 4096, repeats: int = 3, device: str = "cpu", threads: Sequence[int] = (1, 2)
) -> list[dict[str, Any]]:
    """Grid queries of one training step, forward and backward, for each of WORKLOADS and on as many threads.

    The kernels take turns, so that a busy machine slows all alike; each time is the best of `repeats`. `ratio` is
    against the torch reference; `cpu_ratio` by processor time, which other jobs on the machine lengthen less. The rows
    of all grids sum up a step. `floor_share` is the least time memory needs
    (positions and std read, features and weights written, 8 corners of each sample and level gathered once; backward
    scatters them) over the time taken; a share above 1 means that the corners came from the cache. `share_of_limit` and
    its neighbours are those of `limits`, by processor time on a CPU.
    """
    before, rows = torch.get_num_threads(), []
    try:
        for count in threads if device == "cpu" else (before,):
            torch.set_num_threads(count)
            bandwidth = _copy_bandwidth(device)
            for preset, log2_table in WORKLOADS:
                common = {"workload": preset, "threads": count, "rays": rays}
                rows += [
                    common | row for row in _workload(PRESETS[preset], log2_table, rays, repeats, device, bandwidth)
                ]
    finally:
        torch.set_num_threads(before)
    return rows


def _workload(
    config: ZipNerfConfig, log2_table: int | None, rays: int, repeats: int, device: str, bandwidth: float
) -> list[dict[str, Any]]:
    generator = torch.Generator().manual_seed(0)
    log2_table = log2_table or config.grid_log2_table
    rows: list[dict[str, Any]] = []
    total: dict[tuple[str, str], Times] = {}
    asked: dict[str, Work] = {"forward": Work(), "backward": Work()}
    for max_resolution, features, intervals in zip(config.grid_max, config.grid_features, config.samples, strict=True):
        layout = make_layout(config.grid_base, max_resolution, log2_table, features)
        # Samples along rays through the cube, their spread that of a pixel of a 512-pixel image.
        start = torch.rand((rays, 1, 1, 3), generator=generator)
        end = torch.rand((rays, 1, 1, 3), generator=generator)
        along = torch.linspace(0, 1, intervals * 6).view(1, intervals, 6, 1)
        positions = (start + (end - start) * along).view(-1, 6, 3).to(device)
        std = (1e-4 + 1e-3 * along[..., 0]).expand(rays, -1, -1).reshape(-1, 6).to(device)
        table = torch.randn((layout.rows, features), generator=generator).to(device).requires_grad_()
        gradient = torch.randn((rays * intervals, layout.levels, features + 1), generator=generator).to(device)
        best = _best_times(table, positions, std, layout, gradient, repeats, device)
        count = rays * intervals
        corners = count * 6 * 8 * layout.levels * features * 4
        moved = count * (6 * 16 + layout.levels * (features + 1) * 4)
        grid = f"2^{log2_table} to {max_resolution}, F={features}"
        work = {phase: grid_query(layout, count, 6, phase) for phase in asked}
        asked = {phase: asked[phase] + work[phase] for phase in asked}
        for (name, phase), times in best.items():
            total[name, phase] = _sum([total.get((name, phase), (0.0, 0.0)), times])
            floor = (moved + corners * (1 if phase == "forward" else 2)) / bandwidth
            rows.append(_kernel_row(grid, phase, name, rays, times, best["torch reference", phase])
                        | {"intervals_per_ray": intervals, "floor_share": floor / times[0]}
                        | _share(work[phase], times, device))  # fmt: skip
    for name in _kernels(device):
        for phase in ("forward", "backward", "both"):
            phases = ("forward", "backward") if phase == "both" else (phase,)
            times, reference = (_sum([total[k, p] for p in phases]) for k in (name, "torch reference"))
            work_all = functools.reduce(Work.__add__, (asked[p] for p in phases))
            rows.append(_kernel_row("all", phase, name, rays, times, reference) | _share(work_all, times, device))
    return rows


def _share(work: Work, times: Times, device: str) -> dict[str, Any]:
    return limits.columns(work, times[device == "cpu"], "cpu" if device == "cpu" else "wall", device=device)


def _sum(times: Sequence[Times]) -> Times:
    return sum(wall for wall, _ in times), sum(cpu for _, cpu in times)


def _kernel_row(grid: str, phase: str, kernel: str, rays: int, times: Times, reference: Times) -> dict[str, Any]:
    return {
        "grid": grid, "phase": phase, "kernel": kernel, "ms": times[0] * 1e3, "cpu_ms": times[1] * 1e3,
        "rays_per_s": rays / times[0], "ratio": reference[0] / times[0], "cpu_ratio": reference[1] / times[1],
    }  # fmt: skip


def _best_times(
    table: Tensor, positions: Tensor, std: Tensor, layout: GridLayout, gradient: Tensor, repeats: int, device: str
) -> dict[tuple[str, str], Times]:
    """(kernel, phase) -> the best times."""
    best: dict[tuple[str, str], Times] = {}
    for _ in range(repeats):
        for name, query in _kernels(device).items():
            table.grad = None
            kept: list[Tensor] = []

            def forward(query: Query = query, kept: list[Tensor] = kept) -> None:
                kept.append(query(table, positions, std, layout))

            def backward(kept: list[Tensor] = kept) -> None:
                kept.pop().backward(gradient)

            for phase, run in (("forward", forward), ("backward", backward)):
                last = best.get((name, phase), (math.inf, math.inf))
                best[name, phase] = tuple(map(min, last, _timed(run, device)))  # type: ignore[assignment]
    return best
