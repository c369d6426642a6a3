"""Every benchmark by name: what it measures, the rows it gives, and which of its columns make a front.

Rows are dictionaries; `default` says whether a row is what `cat3d` does unless told otherwise. The panels of a
benchmark set a cost against an error or a quality: the front is worth choosing from, the rest is beaten in both.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from cat3d_core.diffusion import GuidanceConfig
from cat3d_core.generation.advice import MEASURED
from cat3d_core.metrics.perceptual import find_perceptual
from cat3d_core.weights import default_model_path
from cat3d_core.zipnerf import PRESETS
from flows.bench import cameras, metrics, plan, poses, reconstruct, sampler, scenes, skips, splats, store, synthetic
from flows.bench.peers import compare
from flows.bench.rows import MissingError, Row, marked, scenes_of
from flows.bench.size import size_rows
from flows.generation.formats import cat3d
from flows.media.images import read_image
from flows.readers import read_capture
from flows.training import evaluation
from schemas.config import PosesConfig, ReconstructConfig, SampleConfig


@dataclass(frozen=True)
class Panel:
    """One plot for each combination of values in the columns `each`, over the rows with the values of `where`.

    cost: column on the x axis, less is better. value: column on the y axis; `higher_is_better` for a quality.
    series: columns that tell the colours apart. label: further columns that name a point.
    """

    title: str
    cost: str
    value: str
    series: tuple[str, ...]
    label: tuple[str, ...] = ()
    each: tuple[str, ...] = ()
    where: tuple[tuple[str, Any], ...] = ()
    higher_is_better: bool = False


@dataclass(frozen=True)
class Bench:
    """`run(quick, data)` measures: quick is seconds to a minute on one free core; data is a folder of real scenes or
    None. It raises MissingError where data or a model is needed and not there."""

    summary: str
    run: Callable[[bool, Path | None], list[Row]]
    panels: tuple[Panel, ...] = ()


def _devices() -> list[str]:
    return ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]


def _model_file() -> Path:
    try:
        return default_model_path()
    except FileNotFoundError as error:
        raise MissingError(str(error)) from None


def sampler_rows(quick: bool, data: Path | None) -> list[Row]:
    """The closed-form mixture, and in full also the shipped model where there is one."""
    chosen = {n: getattr(MEASURED, n) for n in ("solver", "nodes", "steps")} | {"dtype": SampleConfig().precision}
    steps = tuple(sorted({8, 10, 20, 50, MEASURED.steps} | (set() if quick else {12, 15, 30})))
    rows = sampler.rows(None, steps, groups=8 if quick else 64)
    if not quick:
        with contextlib.suppress(MissingError):
            rows += sampler.rows(_model_file(), steps)
    bounds = MEASURED.guidance.low_log_snr, MEASURED.guidance.high_log_snr
    interval = next(name for name, found in sampler.INTERVALS.items() if found == bounds)
    return marked(rows, chosen | {"interval": interval, "problem": "mixture"})  # a model's file has its own default


def reconstruct_rows(quick: bool, data: Path | None) -> list[Row]:
    """Presets (`paper` on a GPU only) and what changes around the default one, on procedural scenes."""
    default: str = ReconstructConfig().preset
    rows: list[Row] = []
    for device in _devices():
        if quick:
            size: Row = {"train": 16, "test": 3, "size": 48, "device": device}
            for preset in ("tiny", default):
                rows += reconstruct.curves(preset, vary=(), **size)
            rows += reconstruct.curves(default, vary=("samples",), iterations=100, **size)
        else:
            for preset in ("tiny", "fast", "balanced", *(["paper"] if device == "cuda" else [])):
                rows += reconstruct.curves(preset, ("dtu",), vary=(), device=device)
                vary = tuple(reconstruct.VARIATIONS) if preset == default else ()
                rows += reconstruct.curves(preset, ("mip360",), vary, device=device)
    whole = float(PRESETS[default].iterations)
    return marked(rows, {"preset": default, "varied": "preset", "iterations": whole})


def scene_rows(quick: bool, data: Path | None) -> list[Row]:
    """All training views of real scenes, captured views only, at the default preset; quick: a tenth of it on one."""
    default: str = ReconstructConfig().preset
    config = replace(PRESETS[default], lpips_weight=0.0)
    if quick:
        config = replace(config, iterations=config.iterations // 10, warmup_iterations=config.warmup_iterations // 10)
    found = scenes_of(data, ["llff_fern"] if quick else list(scenes.DOWNSCALE))
    return [{"preset": default} | scenes.row(scene, "all", config, scenes.DOWNSCALE[scene.name]) for scene in found]


def geometry_rows(quick: bool, data: Path | None) -> list[Row]:
    from flows.bench import geometry  # Open3D, which nothing else here needs

    rows = [row for device in _devices() for row in geometry.rows(quick, device)]
    return marked(rows, {"preset": ReconstructConfig().preset})


def kernel_rows(quick: bool, data: Path | None) -> list[Row]:
    rows = []
    for device in _devices():
        found = reconstruct.kernels(256 if quick else 4096, repeats=2, device=device)
        rows += [{"device": device} | row for row in found]
    return rows


def pose_rows(quick: bool, data: Path | None) -> list[Row]:
    default = PosesConfig().max_features
    features = sorted({1000, default} if quick else {1000, 2000, 4000, 8000, default})
    scenes = scenes_of(data, ["strecha_fountain_P11"] if quick else list(poses.SCENES))
    rows = [poses.measure(scene, poses.SCENES[scene.name], count) for scene in scenes for count in features]
    return marked(rows, {"features": default})


def camera_rows(quick: bool, data: Path | None) -> list[Row]:
    """The scenes of `data` that have cameras, else procedural ones."""
    sources: list[str | Path] = list(cameras.PROCEDURAL)
    if data is not None:
        known = [*poses.SCENES, "dtu_scan37", "re10k_bedroom", "mipnerf360_bonsai", "nerf_synthetic_lego"]
        sources = list(scenes_of(data, known[:1] if quick else known))
    return cameras.rows(sources[:1] if quick else sources, trials=15 if quick else 105)


def metric_rows(quick: bool, data: Path | None) -> list[Row]:
    rows = metrics.rows(2, 252, 336, 3) if quick else metrics.rows()
    return marked(rows, {"implementation": "cat3d"})


def plan_rows(quick: bool, data: Path | None) -> list[Row]:
    return plan.coverage_rows() + plan.timing_rows(2 if quick else 5)


def store_rows(quick: bool, data: Path | None) -> list[Row]:
    """Procedural views, and with `data` also photos of one of its scenes."""
    views, size, repeats = (4, 256, 3) if quick else (8, 512, 5)
    rows = store.rows(views, size, repeats)
    if data is not None:
        scene = scenes_of(data, list(poses.SCENES))[0]
        paths = read_capture(scene).paths[:views]
        photos = [read_image(path)[0] for path in paths]
        rows += store.photo_rows(photos, scene.name, size, repeats)
    return rows


def model_rows(quick: bool, data: Path | None) -> list[Row]:
    """As the model's file recommends to sample."""
    generator = cat3d.load(_model_file(), "cpu", "float32")
    advice = generator.spec.advice
    config = replace(advice, guidance=GuidanceConfig(advice.guidance.scale))  # everywhere: the model's own, undiluted
    rows = evaluation.rows(
        generator, 1 if quick else 20, (3,) if quick else (3, 1), config, find_perceptual(),
        captured=evaluation.captured_scenes(data),
    )  # fmt: skip
    chosen = {name: getattr(config, name) for name in ("solver", "nodes", "steps")}
    return [row | chosen | {"guidance": config.guidance.scale} for row in rows]


def skip_rows(quick: bool, data: Path | None) -> list[Row]:
    """Whole runs; with `data` also the real scenes there. What is in `outputs/skips` already isn't measured again."""
    if quick:
        scenes = list(skips.sources(None))[1:2]
        rows = skips.rows(scenes, ("none", "default", "all"), skips.QUICK_BASE, skips.FOLDER / "quick")
    else:
        scenes = list(skips.sources(data))
        rows = skips.rows(scenes, ("none", "default", "all"))
        for family, switches in skips.ALONE.items():
            alone = [(f"{family}, each alone", *scene[1:]) for scene in scenes if f":{family}/" in scene[1]]
            variants = ("none", *(f"only {name}" for name in switches), "default", "all")
            rows += skips.rows(alone, variants, skips.SHORT_BASE, skips.FOLDER / "alone")
    return marked(rows, {"variant": "default"})


def synthetic_rows(quick: bool, data: Path | None) -> list[Row]:
    return synthetic.rows(64, 8, 1) if quick else synthetic.rows()


def splat_rows(quick: bool, data: Path | None) -> list[Row]:
    """The rasteriser's speed, splats of fields (with `data` of captured scenes too), both reconstructors on few
    views."""
    if quick:
        families = ("co3d",)
        rows = splats.kernel_rows(1, (1,))
        rows += splats.conversion_rows(splats.procedural_scenes(families, 32), steps=60)
        return rows + splats.method_rows(families, (3,), (0,), (("splats", "tiny"),), size=32)
    rows = splats.kernel_rows() + splats.conversion_rows(splats.procedural_scenes())
    if data is not None:
        rows += splats.conversion_rows(splats.captured_scenes(scenes_of(data, list(scenes.DOWNSCALE))))
    return rows + splats.method_rows()


_SAMPLER_POINT = {"series": ("solver", "nodes"), "label": ("steps", "dtype"), "each": ("interval",)}
BENCHES: dict[str, Bench] = {
    "sampler": Bench(
        "solvers, noise levels, steps, guidance interval and number format against a 1,000-step float64 reference",
        sampler_rows,
        (
            Panel("Sampler, closed-form mixture, against guidance everywhere", "evaluations", "error_guided_p90",
                  ("solver", "nodes"), ("steps", "interval", "dtype"), where=(("problem", "mixture"),)),
            Panel("Sampler, shipped model", "seconds", "error", where=(("problem", "model"),),
                  **_SAMPLER_POINT),  # type: ignore[arg-type]
        ),
    ),
    "reconstruct": Bench(
        "held-out PSNR of the field against seconds of training: presets, samples, grid, batch",
        reconstruct_rows,
        (Panel("Reconstruction", "seconds", "psnr_db", ("preset", "varied"), ("setting", "iterations"),
               ("family", "device"), higher_is_better=True),),
    ),
    "scenes": Bench(
        "held-out quality of dense training on real scenes, captured views only (needs --data)", scene_rows
    ),
    "geometry": Bench(
        "depth and mesh of the field against exact surfaces of procedural scenes",
        geometry_rows,
        (Panel("Geometry", "train_s", "depth_abs_rel", ("preset",), each=("family", "device")),),
    ),
    "kernels": Bench("the hash grid query beside plain torch and the memory's floor", kernel_rows),
    "poses": Bench(
        "camera estimation by its number of image features, against the known cameras of real scenes (needs --data)",
        pose_rows,
        (Panel("Poses", "seconds", "rotation_deg_median", ("features",), each=("scene",)),),
    ),
    "cameras": Bench(
        "wrong given cameras: false alarms and seconds of the check, and which random damage it catches", camera_rows
    ),
    "metrics": Bench(
        "PSNR, SSIM and the perceptual distance beside other packages: seconds and rounding error",
        metric_rows,
        (Panel("Metric", "seconds_per_view", "error", ("implementation",), each=("metric",)),),
    ),
    "plan": Bench("how well anchors cover a trajectory against random choice, and how long planning takes", plan_rows),
    "store": Bench(
        "codecs and number formats of images and latents in the scene store: size, speed, error",
        store_rows,
        (
            Panel("Store, time and size", "cpu_ms_per_view", "bytes_per_view", ("codec",), each=("content", "source"),
                  where=(("store_format", True),)),
            Panel("Store, size and error", "bytes_per_view", "error", ("format",), each=("content", "source"),
                  where=(("store_codec", True),)),
        ),
    ),
    "model": Bench("samples of the shipped model on held-out scenes, beside baselines and ceiling", model_rows),
    "skips": Bench(
        "time and quality of whole runs with nothing skipped, each skip alone, the defaults, and everything skipped",
        skip_rows,
        (Panel("Skips", "cpu_seconds", "psnr_db", ("variant",), each=("set",), where=(("scene", "mean"),),
               higher_is_better=True),),
    ),
    "splats": Bench(
        "the rasteriser beside plain torch, splats of a field beside the field, splats beside zipnerf on few views",
        splat_rows,
        (Panel("Reconstructors", "cpu_s", "psnr", ("method",), ("preset", "seed"), ("family", "views"),
               higher_is_better=True),),
    ),
    "peers": Bench(
        "other programs beside ours on one task each: reconstruction, poses, metrics, sampler, network, store",
        compare.rows,
        (
            Panel("Reconstruction beside nerfacto", "seconds", "psnr_db", ("who", "setting"), ("step",),
                  ("scene", "views"), where=(("part", "reconstruction"),), higher_is_better=True),
            Panel("Samplers", "steps", "error", ("who", "setting"), where=(("part", "sampler"),)),
        ),
    ),
    "size": Bench(
        "seconds and peak memory of a whole run by the number and size of the photos, as phones make them; with peers "
        "nerfacto's beside them",
        size_rows,
        (
            Panel("Seconds by the number of photos", "photos", "seconds", ("who", "megapixels")),
            Panel("Memory by the number of photos", "photos", "peak_gb", ("who", "megapixels")),
        ),
    ),
    "synthetic": Bench("procedural scenes rendered: views a second per family", synthetic_rows),
}  # fmt: skip
