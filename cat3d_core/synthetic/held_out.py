"""Procedural scenes that no training sees, to measure models on."""

from __future__ import annotations

import torch

from cat3d_core.cameras import Cameras
from cat3d_core.normalization import normalize_scene
from cat3d_core.random import derive_seed, generator
from cat3d_core.synthetic.capture import random_cameras
from cat3d_core.synthetic.dataset import surface_points
from cat3d_core.synthetic.families import random_scene
from cat3d_core.synthetic.tracer import Traced, trace


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
