"""Training on real scenes with known cameras: held-out quality and seconds, without a store or a server in between."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import torch

from cat3d_core.cameras import Cameras
from cat3d_core.metrics.protocols import evaluate
from cat3d_core.normalization import normalize_scene
from cat3d_core.reconstruction import Views
from cat3d_core.zipnerf import Trainer, ZipNerfConfig, render_image
from flows.bench import limits
from flows.bench.counts import FieldCount
from flows.errors import InputError
from flows.readers import read_capture
from flows.stages.ingest import ingest_view
from schemas.config import IngestConfig

#: Scene -> how much its photos are shrunk: all end near 100 pixels.
DOWNSCALE = {"fox": 8, "llff_fern": 5, "mipnerf360_bonsai": 8}
PROTOCOL = "google"


def scene_views(folder: Path, split: str, downscale: int) -> tuple[Views, Views]:
    """Training and held-out views of a scene's split, in the normalised scene. Raises InputError without cameras or
    such a split."""
    capture = read_capture(folder)
    if capture.cameras is None or split not in capture.splits:
        raise InputError(f"{folder} has no known cameras or no split {split}.")
    settings = IngestConfig(downscale=downscale)
    similarity = normalize_scene(capture.cameras, capture.points, capture.depth_bounds)

    def views(rows: list[int]) -> Views:
        cameras, images = [], []
        for row in rows:
            seen = ingest_view(capture, row, settings)
            height, width = seen.image.shape[:2]
            pose = capture.cameras[row].world_from_camera  # type: ignore[index]
            assert seen.intrinsics is not None
            cameras.append(Cameras(seen.intrinsics[None], pose, torch.tensor([[width, height]])))
            images.append(torch.from_numpy(seen.image))
        return Views.from_images(
            similarity.cameras(Cameras.cat(cameras)), images, torch.ones(len(rows), dtype=torch.bool)
        )

    return views(capture.splits[split]["train"]), views(capture.splits[split]["test"])


def row(folder: Path, split: str, config: ZipNerfConfig, downscale: int, seed: int = 0) -> dict[str, Any]:
    """Train once: mean PSNR (dB) and SSIM over the held-out views, seconds of training and of a rendered view, and the
    share of the machine's limits that a step of training reaches, by processor time (`limits`)."""
    train, held = scene_views(folder, split, downscale)
    trainer = Trainer(config, train, seed)
    started, cpu = time.perf_counter(), time.process_time()
    with FieldCount(trainer.field) as count:
        while not trainer.finished:
            trainer.step()
    seconds, cpu_seconds = time.perf_counter() - started, time.process_time() - cpu
    share = limits.columns(count.steps(trainer.iteration), cpu_seconds / trainer.iteration, "cpu")
    started, found = time.perf_counter(), []
    for index in range(len(held)):
        image = render_image(trainer.field, held.cameras, index).image
        truth = held.image(index).float() / 255
        found.append(evaluate(PROTOCOL, image.permute(2, 0, 1), truth.permute(2, 0, 1)))
    return {
        "scene": folder.name, "split": split, "train_views": len(train), "test_views": len(held),
        "width": int(train.size[0, 0]), "height": int(train.size[0, 1]), "iterations": trainer.iteration,
        "psnr_db": sum(view["psnr"] for view in found) / len(found),
        "ssim": sum(view["ssim"] for view in found) / len(found),
        "train_s": seconds, "train_cpu_s": cpu_seconds,
        "render_s_per_view": (time.perf_counter() - started) / len(held), **share,
    }  # fmt: skip
