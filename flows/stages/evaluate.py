"""Stage evaluate: renders of held-out views against the photos, one row per view and protocol."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from cat3d_core.cameras import Cameras
from cat3d_core.metrics.clip import VARIABLE as CLIP_VARIABLE
from cat3d_core.metrics.clip import ClipImageTower, find_clip
from cat3d_core.metrics.depth import depth_errors
from cat3d_core.metrics.geometry import chamfer_distance
from cat3d_core.metrics.perceptual import PerceptualDistance, find_perceptual, perceptual_name
from cat3d_core.metrics.protocols import PROTOCOLS, evaluate
from cat3d_core.synthetic.dataset import surface_points
from flows.pipeline.jobs import Job, Outcome
from flows.progress import meter
from flows.stages.common import read_cameras, read_similarity, views_with_role
from schemas.errors import ConfigError
from schemas.scene_store import SceneStore
from schemas.tables import METRICS, append_rows

VERSION = 2
#: Surfaces further from the scene's origin than this (scene units) don't count in surface_chamfer.
RADIUS = 2.0
#: Points of each surface that are compared at most: every pair of them is measured.
SURFACE_POINTS = 4096


def inputs(job: Job) -> dict[str, Any]:
    """Which perceptual networks this machine has decides the LPIPS and CLIP columns."""
    clip = find_clip()
    return {
        "perceptual": perceptual_name() if job.config.evaluate.lpips else None,
        "clip": clip.name if clip else None,
    }


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
        clip = find_clip()
        if clip is None:
            decisions.append(f"No CLIP weights ({CLIP_VARIABLE} names a file of them): the clip_score column is empty.")
        renders = run.renders("test")
        names = store.captured.read("name")
        depths = job.capture().depths
        cameras, scale = read_cameras(renders), read_similarity(store).scale
        with meter(f"evaluate {job.scene_id} {job.run}", len(test)) as progress:
            for i, view in enumerate(test):
                image, truth = renders.read_image("image", i), store.captured.read_image("image", view)
                mask = store.captured.read_image("mask", view) if "mask" in store.captured else None
                common = _what(job, key) | {"view": view, "view_name": str(names[view])} | clip_row(clip, image, truth)
                if depths is not None:
                    depth, opacity = renders.read_image("depth", i), renders.read_image("opacity", i)
                    common |= geometry_row(depth, opacity, depths[view] * np.float32(scale), cameras[i])
                for protocol in job.config.evaluate.protocols:
                    rows.append(common | view_row(protocol, image, truth, mask, perceptual))
                progress.advance()
    else:
        decisions.append("This run has no rendered held-out views: there is nothing to compare.")
    append_rows(job.results_path / "metrics", METRICS, rows, f"{job.scene_id}.{job.run}")
    return Outcome({"views": len(test)}, decisions)


def _what(job: Job, key: str) -> dict[str, Any]:
    """The columns that say what a row is of."""
    return {
        "scene_id": job.scene_id, "dataset": job.dataset, "run": job.run, "method": job.label,
        "split": job.config.split, "seed": job.config.seed, "key": key, "code_version": str(VERSION),
    }  # fmt: skip


def _image(pixels: np.ndarray) -> Tensor:
    """(H, W, 3) uint8 -> (3, H, W) float32 in [0, 1]."""
    return torch.from_numpy(pixels.astype(np.float32) / 255).permute(2, 0, 1)


def view_row(
    protocol: str, image: np.ndarray, truth: np.ndarray, mask: np.ndarray | None, perceptual: PerceptualDistance | None
) -> dict[str, Any]:
    """One view under one protocol, from (H, W, 3) uint8: masked where the protocol defines masks and there is one."""
    masked = mask is not None and PROTOCOLS[protocol].mask != "none"
    weight = torch.from_numpy((mask >= 128).astype(np.float32)) if mask is not None and masked else None
    measured = evaluate(protocol, _image(image), _image(truth), weight, perceptual)
    lpips = measured.get(perceptual.name) if perceptual is not None else None
    height, width = image.shape[:2]
    return {
        "protocol": protocol, "width": width, "height": height, "masked": masked, "psnr_db": measured["psnr"],
        "ssim": measured["ssim"], "lpips": lpips,
        "lpips_backbone": perceptual.name if perceptual is not None and lpips is not None else None,
    }  # fmt: skip


def clip_row(clip: ClipImageTower | None, image: np.ndarray, truth: np.ndarray) -> dict[str, Any]:
    """CLIP score of one view, from (H, W, 3) uint8; nothing without the network."""
    if clip is None:
        return {}
    return {"clip_score": float(clip.score(_image(image)[None], _image(truth)[None])), "clip_network": clip.name}


def geometry_row(depth: np.ndarray, opacity: np.ndarray, truth: np.ndarray, camera: Cameras) -> dict[str, Any]:
    """Depth and surface errors of one view. depth, opacity (h, w): rendered; truth (H, W): true z-depth, both in scene
    units, inf where there is no surface. A column is left out where one of the two has no surface to compare."""
    height, width = depth.shape
    rows, columns = (((np.arange(n) + 0.5) * m / n).astype(int) for n, m in zip((height, width), truth.shape))
    exact = torch.from_numpy(truth[rows][:, columns]).double()
    found = torch.from_numpy(depth).double()
    row: dict[str, Any] = {}
    if bool(exact.isfinite().any()):
        row["depth_abs_rel"] = float(depth_errors(found[None], exact[None])["abs_rel"])
    found = found.where(torch.from_numpy(opacity) >= 0.5, torch.inf)
    surfaces = [_surface(z, camera) for z in (found, exact)]
    if all(len(points) for points in surfaces):
        row["surface_chamfer"] = chamfer_distance(surfaces[0], surfaces[1])["chamfer"]
    return row


def _surface(depth: Tensor, camera: Cameras) -> Tensor:
    """(P, 3) points near the scene's origin that the view sees, evenly thinned out; depth inf: nothing there."""
    points = surface_points(depth[None], camera)
    points = points[points.norm(dim=-1) <= RADIUS]
    return points[:: max(1, -(-len(points) // SURFACE_POINTS))]
