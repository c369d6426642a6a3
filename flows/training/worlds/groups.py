"""One capture of a world: placed, lit, photographed, in the unit that captures have (`normalize_scene`)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cat3d_core.cameras import Cameras
from cat3d_core.normalization import normalize_scene
from cat3d_core.random import derive_seed
from cat3d_core.synthetic.capture import look_at
from cat3d_core.synthetic.dataset import surface_points
from flows.training.worlds.light import Light, Sky, radiance, sunlit
from flows.training.worlds.placing import KINDS, place
from flows.training.worlds.textures import srgb_from_linear
from flows.training.worlds.world import World, dot

ATTEMPTS = 60
# 99 % of a group's pixels are no nearer than this inverse depth (scene units); a plane sweep sees up to 2.8 or so.
# A share of the groups may be nearer.
NEAR, NEARER, NEARER_SHARE = 2.8, 8.0, 0.15
MAX_SKY = 0.6
MAX_BACK_SHARE = 0.02
MIN_CONTRAST = 0.06
# This share of the rays ends on something that isn't floor (its normal's z is below MAX_FLATNESS) and not too far.
MIN_STANDING, MAX_FLATNESS, FAR_METRES = 0.2, 0.8, 30.0
_COARSE = 16
_FOV = {"forward": (42, 62), "orbit": (40, 60), "look_around": (60, 80), "walk": (55, 80), "round": (45, 65)}


@dataclass(frozen=True)
class Group:
    """V photographs of a world. image (V, 3, H, W) uint8 sRGB; cameras: of the normalised scene, float64;
    inverse_depth (V, H, W) float32, of the surface at the pixel's centre, in that unit, 0 for the sky; kind: how the
    cameras stand."""

    image: Tensor
    cameras: Cameras
    inverse_depth: Tensor
    kind: str


@dataclass(frozen=True)
class Studio:
    """A world and its sky, ready to be photographed. name: of the track."""

    name: str
    world: World
    sky: Sky


def group(studio: Studio, number: int, views: int, size: int, seed: int) -> Group:
    """Group `number` of a track: the same pictures for the same numbers, wherever and whenever it is made.

    Raises ValueError where ATTEMPTS draws find no place for it."""
    kind = KINDS[number % len(KINDS)]
    for attempt in range(ATTEMPTS):
        random = np.random.default_rng(derive_seed(seed, "world group", studio.name, number, attempt))
        placed = place(studio.world, kind, random, views)
        if placed is None:
            continue
        cameras = _cameras(*placed, math.radians(random.uniform(*_FOV[kind])), size, random)
        found = _photograph(studio, cameras, kind, random)
        if found is not None:
            return found
    raise ValueError(f"Track {studio.name} has no room for group {number} ({kind}) in {ATTEMPTS} draws.")


def _cameras(eyes: NDArray, targets: NDArray, fov: float, size: int, random: np.random.Generator) -> Cameras:
    count, focal = len(eyes), size / 2 / math.tan(fov / 2)
    roll = torch.from_numpy(random.uniform(-0.03, 0.03, count))
    intrinsics = torch.tensor([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]], dtype=torch.float64)
    poses = look_at(torch.from_numpy(eyes), torch.from_numpy(targets), roll)
    return Cameras(intrinsics.repeat(count, 1, 1), poses, torch.full((count, 2), size))


def _photograph(studio: Studio, cameras: Cameras, kind: str, random: np.random.Generator) -> Group | None:
    """The group, or None where a coarse look says that it shows too little, stands too near or behind surfaces."""
    world, size, sky = studio.world, int(cameras.size[0, 0]), studio.sky
    coarse, points, normals, back = _coarse_look(world, cameras)
    if back > MAX_BACK_SHARE or (coarse.isinf().float().mean((1, 2)) > MAX_SKY).any():
        return None
    standing = (normals[:, 2] < MAX_FLATNESS) & (coarse[coarse.isfinite()].numpy() < FAR_METRES)
    if standing.sum() < MIN_STANDING * coarse.numel():
        return None
    seen = surface_points(coarse, cameras) if random.random() < 0.7 else None
    similarity = normalize_scene(cameras, seen)
    inverse = 1 / (coarse * similarity.scale)
    if float(inverse.flatten().quantile(0.99)) > (NEARER if random.random() < NEARER_SHARE else NEAR):
        return None
    light = draw_light(world, points, normals, sky, random)
    linear = np.stack([view_light(world, cameras, view, light) for view in range(len(cameras))])
    image = _developed(linear, random)
    if float(image.std((1, 2)).mean()) < MIN_CONTRAST:
        return None
    depth = torch.stack([view_depth(world, cameras, view) for view in range(len(cameras))]) * similarity.scale
    pixels = torch.from_numpy((255 * image + 0.5).astype(np.uint8)).permute(0, 3, 1, 2)
    assert pixels.shape[-1] == size
    return Group(pixels.contiguous(), similarity.cameras(cameras), 1 / depth.float(), kind)


def _rays(cameras: Cameras, view: int, width: int, height: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Origins and directions (H * W, 3) through the centres of width x height pixels; directions of z-depth 1, so that
    distances along them are depths."""
    camera = cameras[view].resize(width, height)
    k, pose = camera.intrinsics[0].numpy(), camera.world_from_camera[0].numpy()
    x, y = (np.arange(width) + 0.5 - k[0, 2]) / k[0, 0], (np.arange(height) + 0.5 - k[1, 2]) / k[1, 1]
    local = np.stack([*np.meshgrid(x, y), np.ones((height, width))], -1).reshape(-1, 3)
    directions = (local @ pose[:3, :3].T).astype(np.float32)
    return np.broadcast_to(pose[:3, 3].astype(np.float32), directions.shape), directions


def _coarse_look(world: World, cameras: Cameras) -> tuple[Tensor, NDArray, NDArray, float]:
    """z-depth (V, c, c) on a coarse grid, the points hit and their normals (P, 3), the share of solid surfaces seen
    from behind."""
    depths, points, normals, back, solid = [], [], [], 0, 0
    for view in range(len(cameras)):
        origins, directions = _rays(cameras, view, _COARSE, _COARSE)
        hits = world.cast(origins, directions)
        found, d = hits.found, directions[hits.found]
        depths.append(torch.from_numpy(hits.distance.reshape(_COARSE, _COARSE)))
        face = world.face_normals[hits.triangle[found]]
        behind = dot(face, d) > 0
        opaque = world.table.kind[world.material[hits.triangle[found]]] == 0
        back, solid = back + int((behind & opaque).sum()), solid + int(opaque.sum())
        points.append(origins[found] + hits.distance[found, None] * d)
        normals.append(np.where(behind[:, None], -face, face))
    return torch.stack(depths), np.concatenate(points), np.concatenate(normals), back / max(solid, 1)


def draw_light(world: World, points: NDArray, normals: NDArray, sky: Sky, random: np.random.Generator) -> Light:
    """A sun that reaches a fair part of what is seen, or lamps without shadows where none of eight does."""
    chosen = slice(None, None, max(1, len(points) // 400))
    tint = np.array([1.0, random.uniform(0.88, 1.0), random.uniform(0.72, 1.0)])
    above = np.array([random.uniform(0.75, 1.0), random.uniform(0.88, 1.0), 1.0]) * random.uniform(0.3, 0.7)
    below = random.uniform(0.35, 0.7) * above.mean() * tint
    sun = np.array([0.0, 0.0, 1.0])
    for _ in range(8):
        azimuth, height = random.uniform(0, 2 * math.pi), math.radians(random.uniform(18, 70))
        sun = np.array([math.cos(azimuth) * math.cos(height), math.sin(azimuth) * math.cos(height), math.sin(height)])
        if sunlit(world, points[chosen], normals[chosen], sun).mean() > 0.2:
            return Light(sun, random.uniform(0.7, 1.6) * tint, above, below, True, sky)
    return Light(sun, random.uniform(0.4, 0.8) * tint, 1.3 * above, 1.3 * below, False, sky)


def view_light(world: World, cameras: Cameras, view: int, light: Light) -> NDArray[np.float32]:
    """(H, W, 3) linear light of a view, four rays a pixel."""
    width, height = cameras.size[view].tolist()
    origins, directions = _rays(cameras, view, 2 * width, 2 * height)
    angle = 1 / (2 * float(cameras.intrinsics[view, 0, 0]))
    color = radiance(world, world.cast(origins, directions), origins, directions, angle, light)
    return color.reshape(height, 2, width, 2, 3).mean((1, 3))


def view_depth(world: World, cameras: Cameras, view: int) -> Tensor:
    """(H, W) z-depth in metres at the pixels' centres, inf for the sky."""
    width, height = cameras.size[view].tolist()
    return torch.from_numpy(world.cast(*_rays(cameras, view, width, height)).distance.reshape(height, width))


def _developed(linear: NDArray, random: np.random.Generator) -> NDArray:
    """sRGB in [0, 1] (V, H, W, 3): one exposure for the group, so that a few highlights are clipped."""
    bright = float(np.quantile(linear.mean(-1), 0.9))
    exposure = random.uniform(0.45, 0.8) / max(bright, 1e-3)
    return srgb_from_linear((exposure * linear).clip(0, 1))
