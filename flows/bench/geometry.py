"""Geometry of the reconstruction against procedural scenes, whose depth is exact: depth maps and the fused mesh.

Depth on held-out views: absolute relative error (Eigen et al. 2014). Mesh: Chamfer distance (DTU's: the mean of
accuracy and completeness) to the surface that the training views see, in normalised scene units (mean distance from
the cameras to what they look at: 1). What lies beyond RADIUS is left out of the mesh and of its truth.
"""

from __future__ import annotations

import dataclasses
import time
from typing import Any

import numpy as np
import torch
from torch import Tensor

from cat3d_core.metrics.depth import depth_errors
from cat3d_core.metrics.geometry import chamfer_distance
from cat3d_core.normalization import normalize_scene
from cat3d_core.random import generator
from cat3d_core.reconstruction import Views, surface_depth
from cat3d_core.synthetic import random_cameras, random_scene, trace
from cat3d_core.synthetic.dataset import surface_points
from cat3d_core.zipnerf import PRESETS, Field, Trainer, ZipNerfConfig, render_image
from flows.bench import limits
from flows.bench.counts import FieldCount
from flows.bench.reconstruct import procedural_views
from flows.errors import InputError
from flows.exports.mesh import Mesh, fuse, without_crumbs

RADIUS = 3.0
SAMPLES = 20_000
#: "Right" for precision, recall and F-score: a fiftieth of the distance to what the cameras look at.
THRESHOLD = 0.02


def measure(
    preset: str, family: str, iterations: int | None = None, views: int = 24, test: int = 4, size: int = 64,
    resolution: int = 256, scale: float = 1.0, seed: int = 0, device: str = "cpu", **changes: Any,
) -> dict[str, Any]:  # fmt: skip
    """Train once on a procedural scene and measure depth and mesh. `changes` are settings of the trainer."""
    config = dataclasses.replace(PRESETS[preset], **changes)
    if iterations is not None:
        config = dataclasses.replace(config, iterations=iterations, warmup_iterations=iterations // 10)
    train, held, truth = procedural_views(family, views, test, size, size, seed)
    trainer = Trainer(config, train, seed, device)
    with FieldCount(trainer.field) as count:
        started = time.perf_counter()
        while not trainer.finished:
            trainer.step()
        seconds = time.perf_counter() - started
    row: dict[str, Any] = {
        "family": family, "preset": preset, "iterations": trainer.iteration, "views": views, "size": size,
        "train_s": seconds, "device": device,
        **limits.columns(count.steps(trainer.iteration), seconds / trainer.iteration, device=device),
    }  # fmt: skip
    row |= depth_row(trainer.field, held, truth)
    started = time.perf_counter()
    try:
        mesh = field_mesh(trainer.field, train, 2 * RADIUS / resolution, scale)
    except InputError:  # nothing opaque, or nothing that two views agree on
        return row | {"faces": 0}
    row |= {"mesh_s": time.perf_counter() - started, "faces": len(mesh.faces)}
    return row | mesh_row(mesh, surface_within(train, true_depths(train, family, views + test, seed)))


def true_depths(views: Views, family: str, count: int, seed: int) -> list[Tensor]:
    """Exact z-depths (H, W), normalised scene units, of views of `procedural_views(family, ...)` with `count` views in
    all."""
    scene = random_scene(family, seed)
    width, height = views.size[0].tolist()
    similarity = normalize_scene(random_cameras(scene, seed, count, width, height))
    cameras = similarity.inverse().cameras(views.cameras.to(dtype=torch.float64))
    return list(trace(scene, cameras, supersample=1).depth.float().cpu() * similarity.scale)


def depth_row(field: Field, held: Views, truth: list[Tensor], config: ZipNerfConfig | None = None) -> dict[str, Any]:
    """Errors of the median depth on the held-out views: all pixels with a surface, and those within RADIUS of it."""
    rendered = [render_image(field, held.cameras, i, config) for i in range(len(held))]
    depth, target = torch.stack([r.depth.cpu() for r in rendered]), torch.stack(truth)
    errors = depth_errors(depth, target)
    near = depth_errors(depth, target, target < 1 + RADIUS)
    return {
        "depth_abs_rel": float(errors["abs_rel"].mean()),
        "depth_delta_1.25": float(errors["delta_1.25"].mean()),
        "depth_abs_rel_near": float(near["abs_rel"].mean()),
    }


def field_mesh(field: Field, views: Views, voxel: float, scale: float = 1.0) -> Mesh:
    """The mesh as `cat3d export` makes it, from the training views."""
    pairs = []
    for i in range(len(views)):
        render = render_image(field, views.cameras, i, resolution_scale=scale)
        depth = surface_depth(render, views.cameras, i, max_depth=float("inf"), max_radius=RADIUS)
        pairs.append((depth.cpu(), render.image.cpu()))
    return without_crumbs(fuse(pairs, views.cameras, voxel))


def surface_within(views: Views, depths: list[Tensor]) -> Tensor:
    """(P, 3) points of the true surface that the views see within RADIUS, at most SAMPLES of them."""
    cameras = views.cameras.to(dtype=torch.float64)
    points = surface_points(torch.stack(depths), cameras)
    points = points[points.norm(dim=-1) <= RADIUS]
    return points[torch.randperm(len(points), generator=generator(0, "bench", "truth"))[:SAMPLES]]


def mesh_row(mesh: Mesh, truth: Tensor, samples: int = SAMPLES) -> dict[str, float]:
    """Chamfer distance and F-score of points drawn evenly over the mesh to the true points (P, 3)."""
    found = chamfer_distance(sample_surface(mesh, samples), truth, THRESHOLD)
    return {name: found[name] for name in ("chamfer", "accuracy", "completeness", "fscore")}


def sample_surface(mesh: Mesh, count: int) -> Tensor:
    """(count, 3) float64 points drawn evenly over the area of the mesh."""
    corners = torch.from_numpy(mesh.vertices[mesh.faces].astype(np.float64))
    sides = corners[:, 1:] - corners[:, :1]
    area = torch.linalg.cross(sides[:, 0], sides[:, 1]).norm(dim=-1)
    random = generator(0, "bench", "mesh")
    # Beyond 2^24 faces multinomial refuses; inverse sampling of the cumulative area has no bound.
    cumulative = area.cumsum(0)
    face = torch.searchsorted(cumulative, torch.rand(count, generator=random).double() * cumulative[-1])
    face = face.clamp_max(len(area) - 1)
    share = torch.rand((count, 2), generator=random).double()
    share = torch.where(share.sum(-1, keepdim=True) > 1, 1 - share, share)
    return corners[face, 0] + (share[..., None] * sides[face]).sum(1)


def rows(quick: bool = False, device: str = "cpu") -> list[dict[str, Any]]:
    """Presets on an object (co3d) and an unbounded scene (mip360); quick: `tiny` on the object."""
    if quick:
        return [measure("tiny", "co3d", views=12, test=2, size=48, resolution=128, device=device)]
    presets = ("tiny", "fast", "balanced", *(("paper",) if device != "cpu" else ()))
    return [measure(preset, family, device=device) for preset in presets for family in ("co3d", "mip360")]
