"""Stage evaluate: renders of held-out views against the photos, one row per view and protocol."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from cat3d_core.metrics.perceptual import find_perceptual
from cat3d_core.metrics.protocols import PROTOCOLS, evaluate
from flows.jobs import Job, Outcome
from flows.progress import meter
from flows.stages.common import views_with_role
from schemas.errors import ConfigError
from schemas.scene_store import SceneStore
from schemas.tables import METRICS, append_rows

VERSION = 1


def inputs(job: Job) -> dict[str, Any]:
    """Which perceptual network this machine has decides the LPIPS column."""
    perceptual = find_perceptual() if job.config.evaluate.lpips else None
    return {"perceptual": perceptual.name if perceptual else None}


def execute(job: Job, store: SceneStore, key: str) -> Outcome:
    """Write the rows of this run to `metrics/<scene>.<run>.parquet` in the output folder."""
    unknown = [p for p in job.config.evaluate.protocols if p not in PROTOCOLS]
    if unknown:
        raise ConfigError(f"evaluate.protocols: {unknown[0]} is not a protocol; those are {', '.join(PROTOCOLS)}.")
    run = store.run(job.run)
    test = views_with_role(store, run, "test")
    rows: list[dict[str, Any]] = []
    decisions = []
    if test and job.config.render.test_views:
        perceptual = find_perceptual() if job.config.evaluate.lpips else None
        if perceptual is None:
            decisions.append("No perceptual network on this machine, or lpips is off: the lpips column is empty.")
        renders = run.renders("test")
        names = store.captured.read("name")
        with meter(f"evaluate {job.scene_id} {job.run}", len(test)) as progress:
            for i, view in enumerate(test):
                image, truth = renders.read_image("image", i), store.captured.read_image("image", view)
                mask = store.captured.read_image("mask", view) if "mask" in store.captured else None
                for protocol in job.config.evaluate.protocols:
                    rows += view_rows(job, key, protocol, view, str(names[view]), image, truth, mask, perceptual)
                progress.advance()
    else:
        decisions.append("This run has no rendered held-out views: there is nothing to compare.")
    append_rows(job.out / "metrics", METRICS, rows, f"{job.scene_id}.{job.run}")
    return Outcome({"views": len(test)}, decisions)


def view_rows(job, key, protocol, view, name, image, truth, mask, perceptual) -> list[dict[str, Any]]:
    """Rows of one view: unmasked, or under a protocol that defines masks and where there is one, masked."""
    masked = mask is not None and PROTOCOLS[protocol].mask != "none"
    prediction, target = (torch.from_numpy(x.astype(np.float32) / 255).permute(2, 0, 1) for x in (image, truth))
    weight = torch.from_numpy((mask >= 128).astype(np.float32)) if masked else None
    measured = evaluate(protocol, prediction, target, weight, perceptual)
    lpips = measured.get(perceptual.name) if perceptual is not None else None
    height, width = image.shape[:2]
    return [
        {
            "scene_id": job.scene_id, "dataset": job.dataset, "run": job.run, "method": job.label,
            "split": job.config.split, "seed": job.config.seed, "key": key, "code_version": str(VERSION),
            "protocol": protocol, "view": view, "view_name": name, "width": width, "height": height,
            "psnr_db": measured["psnr"], "ssim": measured["ssim"], "lpips": lpips,
            "lpips_backbone": perceptual.name if lpips is not None else None, "masked": masked,
        }
    ]  # fmt: skip
