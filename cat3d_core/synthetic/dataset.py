"""Training scenes: rendered captures with normalised cameras, and variants of them that cost no rendering."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from cat3d_core.cameras import Cameras
from cat3d_core.normalization import normalize_scene
from cat3d_core.random import generator
from cat3d_core.rays import image_rays
from cat3d_core.synthetic.capture import random_cameras
from cat3d_core.synthetic.families import random_scene
from cat3d_core.synthetic.tracer import render_views, trace

_COARSE = 12


@dataclass(frozen=True)
class Capture:
    """V views of one scene: image (V, 3, H, W) in [0, 1]; cameras of the normalised scene, float64; where asked for,
    inverse_depth (V, H, W): 1 / z-depth at pixel centres in that scene's unit, 0 for the sky."""

    image: Tensor
    cameras: Cameras
    inverse_depth: Tensor | None = None


def surface_points(depth: Tensor, cameras: Cameras) -> Tensor:
    """(P, 3) float64 world points of the finite z-depths (V, h, w), which may be coarser than the cameras' images."""
    height, width = depth.shape[-2:]
    points = []
    for view in range(len(cameras)):
        rays = image_rays(cameras, view, width, height)
        z = depth[view].reshape(-1, 1).double().cpu()
        points.append((rays.origins + z * rays.directions)[z[:, 0].isfinite()])
    return torch.cat(points)


def training_capture(
    family: str, seed: int, views: int, size: int, textures: Tensor | None = None,
    device: torch.device | str = "cpu", with_depth: bool = False,
) -> Capture:  # fmt: skip
    """A random scene of the family, seen from a capture of random spread, on the CPU; with_depth: also inverse depth.

    As in use, some captures are normalised with sparse surface points and some from their cameras alone.
    Raises ValueError where the scene has no free place for the cameras (take the next seed).
    """
    scene = random_scene(family, seed, textures)
    spread, with_points = torch.rand(2, generator=generator(seed, "capture")).tolist()
    cameras = random_cameras(scene, seed, views, size, size, spread=0.35 + 0.65 * spread)
    scene = scene.to(device)
    depth = None
    if with_depth:
        image, depth, _ = (part.cpu() for part in trace(scene, cameras))
    else:
        image = render_views(scene, cameras.to(device, torch.float32))[0].cpu()
    points = None
    if with_points < 0.7:
        points = surface_points(trace(scene, cameras.resize(_COARSE, _COARSE), supersample=1).depth, cameras)
    similarity = normalize_scene(cameras, points)
    return Capture(image, similarity.cameras(cameras), None if depth is None else 1 / (depth * similarity.scale))


def mirrored(capture: Capture) -> Capture:
    """The scene's mirror image: pictures flipped left to right, world and camera x negated (poses stay rigid)."""
    cameras = capture.cameras
    mirror = torch.diag(torch.tensor([-1.0, 1, 1, 1])).to(cameras.world_from_camera)
    intrinsics = cameras.intrinsics.clone()
    intrinsics[:, 0, 2] = cameras.size[:, 0] - intrinsics[:, 0, 2]
    intrinsics[:, 0, 1] *= -1
    pose = mirror @ cameras.world_from_camera @ mirror
    inverse_depth = None if capture.inverse_depth is None else capture.inverse_depth.flip(-1)
    return Capture(
        capture.image.flip(-1), replace(cameras, intrinsics=intrinsics, world_from_camera=pose), inverse_depth
    )


def recoloured(capture: Capture, random: torch.Generator) -> Capture:
    """The same scene with its colour channels permuted."""
    return replace(capture, image=capture.image[:, torch.randperm(3, generator=random)])
