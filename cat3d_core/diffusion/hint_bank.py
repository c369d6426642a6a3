"""Groups of views with what a plane sweep of their given views had to say of the others, for training."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from cat3d_core.cameras import Cameras
from cat3d_core.random import generator
from cat3d_core.rays import reference_from_image


@dataclass(frozen=True)
class HintBank:
    """G groups of V views in memory, the given ones first.

    latents [G, V, C, h, w] and hints [G, V, C + 4, h, w] (hints.py; zero for given views), float16; intrinsics [G, V,
    3, 3] in pixels of an image of `image_size` (width and height); world_from_camera [G, V, 4, 4] of the normalised
    scene; given [G] and family [G] int64.
    """

    latents: Tensor
    hints: Tensor
    intrinsics: Tensor
    world_from_camera: Tensor
    given: Tensor
    family: Tensor
    image_size: int

    def __post_init__(self) -> None:
        groups, views = self.latents.shape[:2]
        if self.hints.shape[:2] != (groups, views) or self.intrinsics.shape != (groups, views, 3, 3):
            raise ValueError(
                f"A bank of {groups} groups of {views} views needs hints and intrinsics of as many; got "
                f"{tuple(self.hints.shape)} and {tuple(self.intrinsics.shape)}."
            )

    def __len__(self) -> int:
        return len(self.latents)

    def batch(self, groups: int, given: int, seed: int, *key: str | int) -> tuple[Tensor, Tensor, Tensor]:
        """Draw latents [groups, V, C, h, w], cameras [groups, V, 4, 4] seen from view 0, and hints [groups, V - given,
        C + 4, h, w], on the CPU, of groups with so many given views.

        Every family is equally likely, then every group of it. The draw depends on the key alone. Raises ValueError
        where no group has so many given views."""
        random = generator(seed, "hint bank", *key)
        families = self.family[self.given == given].unique()
        if not len(families):
            raise ValueError(f"The bank has no groups with {given} given views.")
        rows = []
        for family in families[torch.randint(len(families), (groups,), generator=random)]:
            members = ((self.family == family) & (self.given == given)).nonzero()[:, 0]
            rows.append(members[torch.randint(len(members), (1,), generator=random)])
        row = torch.cat(rows)
        return self.latents[row], self.cameras(row), self.hints[row, given:].float()

    def cameras(self, row: Tensor) -> Tensor:
        """[B, V, 4, 4] float64 of some groups: `rays.reference_from_image`, with view 0 as the reference."""
        size = torch.full((self.latents.shape[1], 2), self.image_size, dtype=torch.int64)
        found = []
        for k, pose in zip(self.intrinsics[row].double(), self.world_from_camera[row].double(), strict=True):
            found.append(reference_from_image(Cameras(k, pose, size), pose[0]))
        return torch.stack(found)
