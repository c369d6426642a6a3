"""Batches for the plane sweep: photos and targets of scenes with exact depth, and what real photos suffer."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
import torch.nn.functional as F
from safetensors.torch import load_file
from torch import Tensor

from cat3d_core.cameras import Cameras
from cat3d_core.matching.losses import SweepBatch
from cat3d_core.matching.network import camera_distance, partners
from cat3d_core.matching.warp import Views, views
from flows.training.renders import shards


@dataclass
class GeometryBank:
    """Rendered scenes with inverse depth of several folders, in memory; each folder is drawn equally often.

    `held` shards of each folder are left for validation."""

    folders: Sequence[Path]
    held: int = 1

    def __post_init__(self) -> None:
        self._loaded: dict[Path, dict[str, Tensor]] = {}
        self.refresh()

    def refresh(self) -> None:
        """Read the shards that have appeared since."""
        for folder in self.folders:
            for path in shards(folder, "renders"):
                if path not in self._loaded:
                    self._loaded[path] = load_file(path)

    def sources(self, validation: bool = False) -> list[list[dict[str, Tensor]]]:
        """The shards of each folder that has some to give."""
        out = []
        for folder in self.folders:
            mine = [self._loaded[p] for p in sorted(self._loaded) if p.parent.parent == folder]
            part = mine[: self.held] if validation else mine[self.held :]
            if part:
                out.append(part)
        return out

    def named(self) -> list[str]:
        """The names of the folders that have scenes, in the order of `sources`."""
        return [folder.name for folder in self.folders if any(p.parent.parent == folder for p in self._loaded)]

    def draw(self, random: torch.Generator) -> dict[str, Tensor]:
        """image, inverse_depth, intrinsics and world_from_camera of one scene."""
        sources = self.sources()
        source = sources[int(torch.randint(len(sources), (), generator=random))]
        shard = source[int(torch.randint(len(source), (), generator=random))]
        scene = int(torch.randint(len(shard["family"]), (), generator=random))
        return {k: shard[k][scene] for k in ("image", "inverse_depth", "intrinsics", "world_from_camera")}

    def __len__(self) -> int:
        return sum(len(shard["family"]) for source in self.sources() for shard in source)


@dataclass(frozen=True)
class Scene:
    """Some views of a scene: image (V, 3, H, W) in [0, 1], inverse_depth (V, H, W), views (V)."""

    image: Tensor
    inverse_depth: Tensor
    views: Views


def chosen(raw: dict[str, Tensor], count: int, spread: float, random: torch.Generator) -> dict[str, Tensor]:
    """`count` views in random order out of the share `spread` of the scene's that stand nearest to one of them."""
    total = len(raw["image"])
    within = max(count, math.ceil(spread * total))
    pose = raw["world_from_camera"]
    first = int(torch.randint(total, (), generator=random))
    near = camera_distance(pose[first : first + 1], pose)[0].argsort()[:within]
    pick = near[torch.randperm(within, generator=random)[:count]]
    return {k: t[pick] for k, t in raw.items()}


def prepared(raw: dict[str, Tensor], size: int, random: torch.Generator) -> Scene:
    """The stored views at another (smaller) size; each small pixel has the depth of one of those it covers."""
    image, depth = raw["image"].float() / 255, raw["inverse_depth"].float()
    side = image.shape[-1]
    cameras = Cameras(raw["intrinsics"], raw["world_from_camera"], torch.tensor([[side, side]]).repeat(len(image), 1))
    if side != size:
        factor = side // size
        image = F.avg_pool2d(image, factor)
        y, x = torch.randint(factor, (2,), generator=random).tolist()
        depth = depth[:, y::factor, x::factor]
    return Scene(image, depth, views(cameras))


def cameras_of(cameras: Views, side: int) -> Cameras:
    """Views as the cameras of square images of `side` pixels."""
    pixels = torch.tensor([[side / 2, 0, side / 2], [0, side / 2, side / 2], [0, 0, 1]], dtype=torch.float64)
    return Cameras(pixels @ cameras.k, cameras.pose, torch.full((len(cameras.k), 2), side, dtype=torch.int64))


def augmented(scene: Scene, random: torch.Generator) -> Scene:
    """Another scene of the same shape: mirrored, recoloured, with other contrast and scale."""
    image, depth, k, pose = scene.image, scene.inverse_depth, scene.views.k.clone(), scene.views.pose.clone()
    image = image[:, torch.randperm(3, generator=random)]
    mirror, contrast, scale = torch.rand(3, generator=random).tolist()
    if mirror < 0.5:
        image, depth = image.flip(-1), depth.flip(-1)
        flip = torch.diag(torch.tensor([-1.0, 1, 1, 1])).to(pose)
        pose = flip @ pose @ flip
        k[:, 0, 2] *= -1
    image = image ** (2 ** (contrast - 0.5))
    factor = 1.4 ** (2 * scale - 1)
    pose[:, :3, 3] *= factor
    return Scene(image, depth / factor, Views(k, pose))


def photographed(image: Tensor, random: torch.Generator) -> Tensor:
    """(M, 3, H, W) as cameras would deliver it: exposure and white balance of each photo, blur, noise."""
    m = len(image)
    kind = torch.rand(3, generator=random).tolist()
    if kind[0] < 0.4:
        strength = torch.rand((), generator=random) * 0.3
        gain = 2 ** (strength * (2 * torch.rand(m, 1, 1, 1, generator=random) - 1))
        balance = 1 + 0.3 * strength * (2 * torch.rand(m, 3, 1, 1, generator=random) - 1)
        image = image * gain * balance
    if kind[1] < 0.25:
        blurred = F.avg_pool2d(F.pad(image, (1, 1, 1, 1), mode="replicate"), 3, 1)
        image = image.lerp(blurred, float(torch.rand((), generator=random)) * 0.6)
    if kind[2] < 0.4:
        image = image + 0.025 * torch.rand((), generator=random) * torch.randn(image.shape, generator=random)
    return image.clamp(0, 1)


def misplaced(cameras: Views, random: torch.Generator) -> Views:
    """Cameras as structure from motion would find them: slightly wrong poses and focal lengths, a third of the time."""
    if float(torch.rand((), generator=random)) > 0.35:
        return cameras
    n = len(cameras.k)
    strength = torch.rand((), generator=random, dtype=torch.float64)
    turn = 0.008 * strength * torch.randn(n, 3, generator=random, dtype=torch.float64)
    zero = torch.zeros(n, dtype=torch.float64)
    x, y, z = turn.unbind(-1)
    skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(n, 3, 3)
    pose, k = cameras.pose.clone(), cameras.k.clone()
    pose[:, :3, :3] = pose[:, :3, :3] @ torch.linalg.matrix_exp(skew)
    pose[:, :3, 3] += 0.008 * strength * torch.randn(n, 3, generator=random, dtype=torch.float64)
    k[:, [0, 1], [0, 1]] *= 1 + 0.015 * strength * torch.randn((), generator=random, dtype=torch.float64)
    return Views(k, pose)


def batch(
    bank: GeometryBank, scenes: int, photos: int, targets: int, size: int, spread: float, random: torch.Generator
) -> SweepBatch:
    """One batch for training; photos + targets views of each scene."""
    parts: list[Scene] = []
    while len(parts) < scenes:
        raw = bank.draw(random)
        if len(raw["image"]) >= photos + targets:
            scene = augmented(prepared(chosen(raw, photos + targets, spread, random), size, random), random)
            given = photographed(scene.image[:photos], random)
            parts.append(
                Scene(torch.cat([given, scene.image[photos:]]), scene.inverse_depth, misplaced(scene.views, random))
            )
    return collated(parts, photos)


def collated(parts: Sequence[Scene], photos: int, at_most: int = 3) -> SweepBatch:
    """Scenes of as many views each; the first `photos` are given, each with `at_most` partners."""
    given, wanted = slice(0, photos), slice(photos, None)
    own = [partners(part.views.pose[given], at_most) + i * photos for i, part in enumerate(parts)]
    rows = torch.cat(
        [(torch.arange(photos) + i * photos).repeat(len(p.image) - photos, 1) for i, p in enumerate(parts)]
    )

    def joined(which: slice) -> tuple[Tensor, Tensor, Views]:
        k, pose = torch.cat([p.views.k[which] for p in parts]), torch.cat([p.views.pose[which] for p in parts])
        depth = torch.cat([p.inverse_depth[which] for p in parts])
        return torch.cat([p.image[which] for p in parts]), depth, Views(k, pose)

    image, depth, cameras = joined(given)
    truth, truth_depth, target = joined(wanted)
    return SweepBatch(image, depth, cameras, torch.cat(own), rows, target, truth, truth_depth)
