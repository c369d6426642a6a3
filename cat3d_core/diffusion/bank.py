"""A bank of latents: scenes rendered and encoded once, groups of views drawn from it for every training step."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from cat3d_core.cameras import Cameras
from cat3d_core.random import generator
from cat3d_core.rays import reference_from_image


@dataclass(frozen=True)
class LatentBank:
    """S scenes of K views, in memory.

    latents [S, K, C, h, w] float16 normalised; intrinsics [S, K, 3, 3] in pixels of an image of `image_size` (width and
    height); world_from_camera [S, K, 4, 4], scenes normalised (mean distance about 1); family [S] int64 (data set).
    """

    latents: Tensor
    intrinsics: Tensor
    world_from_camera: Tensor
    family: Tensor
    image_size: int

    def __post_init__(self) -> None:
        scenes, views = self.latents.shape[:2]
        if self.intrinsics.shape != (scenes, views, 3, 3) or self.world_from_camera.shape != (scenes, views, 4, 4):
            raise ValueError(
                f"A bank of {scenes} scenes with {views} views needs intrinsics [{scenes}, {views}, 3, 3] and "
                f"world_from_camera [{scenes}, {views}, 4, 4]; got {tuple(self.intrinsics.shape)} and "
                f"{tuple(self.world_from_camera.shape)}."
            )

    def __len__(self) -> int:
        return self.latents.shape[0]

    def batch(self, groups: int, views: int, seed: int, *key: str | int, spread: float = 1.0) -> tuple[Tensor, Tensor]:
        """Draw latents [groups, views, C, h, w] and cameras [groups, views, 4, 4] seen from view 0, on the CPU.

        Every family is equally likely (paper, appendix A), then every scene of it. A group is a random view and others
        from the nearest `spread` (0..1] of its scene's cameras, in random order. The draw depends on the key alone.
        """
        random = generator(seed, "bank", *key)
        families = self.family.unique()
        chosen = families[torch.randint(len(families), (groups,), generator=random)]
        index = []
        for family in chosen:
            members = (self.family == family).nonzero()[:, 0]
            index.append(members[torch.randint(len(members), (1,), generator=random)])
        scene = torch.cat(index)
        total = self.latents.shape[1]
        pool = max(views, min(total, round(spread * total)))
        poses = self.world_from_camera[scene]
        center = torch.randint(total, (groups,), generator=random)
        here = poses[torch.arange(groups), center]
        # Nearness in position and viewing direction: both in units of the scene's size and of a radian.
        apart = (poses[:, :, :3, 3] - here[:, None, :3, 3]).norm(dim=-1) + (
            poses[:, :, :3, 2] - here[:, None, :3, 2]
        ).norm(dim=-1)
        near = apart.argsort(1)[:, :pool]
        picked = near.gather(1, torch.rand(groups, pool, generator=random).argsort(1)[:, :views])
        rows = scene[:, None].expand_as(picked)
        return self.latents[rows, picked], self.cameras(rows, picked)

    def cameras(self, scene: Tensor, view: Tensor) -> Tensor:
        """[G, V, 4, 4] float64 for scene and view indices [G, V]: `rays.reference_from_image`, with the first view of
        each group as the reference."""
        poses = self.world_from_camera[scene, view].double()
        intrinsics = self.intrinsics[scene, view].double()
        size = torch.full((*scene.shape, 2), self.image_size, dtype=torch.int64)
        groups = zip(intrinsics, poses, size, strict=True)
        return torch.stack([reference_from_image(Cameras(*group), group[1][0]) for group in groups])
