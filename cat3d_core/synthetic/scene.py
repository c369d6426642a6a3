"""A batch of procedural scenes as plain tensors, so that many scenes are traced in one pass.

Every scene has the same slots (one ground, one room, some spheres, boxes and cylinders); unused slots are inactive.
World frame: right-handed, z up, in scene units (the point the cameras look at is about one to two units away).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch
from torch import Tensor

# Slots of each kind, in the order of the object axis.
SLOTS = {"ground": 1, "room": 1, "sphere": 5, "box": 12, "cylinder": 5}
KINDS = tuple(SLOTS)


def slot_range(kind: str) -> slice:
    """Where the slots of one kind stand on the object axis."""
    start = 0
    for name, count in SLOTS.items():
        if name == kind:
            return slice(start, start + count)
        start += count
    raise ValueError(f"There is no primitive kind '{kind}'; the kinds are {', '.join(SLOTS)}.")


@dataclass(frozen=True)
class Scene:
    """S scenes of P object slots, T textures, K ground waves. All tensors float32 unless said otherwise.

    families: the family of each scene
    object_from_world (S, P, 3, 4): affine map onto the unit shape (sphere |x|=1, box [-1,1]^3, cylinder |xy|=1, |z|<=1)
    half_size (S, P, 3): half extents along the object's axes, world units (texture density is per world unit)
    active (S, P) bool
    texture (S, P) int64: texture slot; texture_scale (S, P): repeats per world unit
    tint, bias (S, P, 3): albedo = bias + tint * texture; gloss (S, P): strength of the highlight (0 = diffuse)
    waves (S, K, 4): ground height = fade(r) sum_k a sin(kx x + ky y + phase) as (kx, ky, phase, a)
    flat_radius (S,): fade(r) = r^2 / (r^2 + flat_radius^2), so the ground is level near the origin
    sky (S, 3, 3): colour at the zenith, at the horizon, and of the haze; panorama (S, 3): texture slot, weight, repeats
    haze_distance (S,): distance at which 63% of the light is haze
    light (S, 4): homogeneous position (w = 0: direction towards the sun); light_colour, ambient (S, 3)
    focus (S, 3): what the cameras look at; reach (S,): usual distance of the cameras from it
    textures (S, T, 3, N, N): tileable colour images in [0, 1]
    """

    families: tuple[str, ...]
    object_from_world: Tensor
    half_size: Tensor
    active: Tensor
    texture: Tensor
    texture_scale: Tensor
    tint: Tensor
    bias: Tensor
    gloss: Tensor
    waves: Tensor
    flat_radius: Tensor
    sky: Tensor
    panorama: Tensor
    haze_distance: Tensor
    light: Tensor
    light_colour: Tensor
    ambient: Tensor
    focus: Tensor
    reach: Tensor
    textures: Tensor

    def __len__(self) -> int:
        return len(self.families)

    def __getitem__(self, index: int) -> Scene:
        """One scene of the batch, as a batch of one."""
        index = range(len(self))[index]
        tensors = {name: getattr(self, name)[index : index + 1] for name in self._tensor_names()}
        return Scene((self.families[index],), **tensors)

    def to(self, device: torch.device | str) -> Scene:
        """Move all tensors."""
        return Scene(self.families, **{name: getattr(self, name).to(device) for name in self._tensor_names()})

    @staticmethod
    def stack(scenes: Sequence[Scene]) -> Scene:
        """Join scenes along the scene axis. Raises ValueError for none."""
        if not scenes:
            raise ValueError("There are no scenes to stack; give at least one.")
        tensors = {name: torch.cat([getattr(s, name) for s in scenes]) for name in Scene._tensor_names()}
        return Scene(tuple(f for s in scenes for f in s.families), **tensors)

    @staticmethod
    def _tensor_names() -> list[str]:
        return [f.name for f in fields(Scene) if f.name != "families"]
