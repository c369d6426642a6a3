"""How strongly each view of a window is guided (classifier-free guidance whose scale depends on the views)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from cat3d_core.cameras import Cameras

Guider = Literal["uniform", "multiview", "temporal"]

_NEAR_DEGREES, _NEAR_DISTANCE = 10.0, 1e-5


@dataclass(frozen=True)
class ViewGuidance:
    """scale: guidance of a view that is unlike the given ones; least: of one that is nearly one of them.

    uniform: `scale` everywhere. multiview: `least` where a given view stands at the same place, one (the same or
    another) looks within 10 degrees and one has the same intrinsics. temporal: besides, the scale falls from `scale`
    for the view that is farthest from any given view in the window's order to `least` for the given views.
    """

    guider: Guider = "multiview"
    scale: float = 2.0
    least: float = 1.2

    def scales(self, cameras: Cameras, given: Tensor) -> Tensor:
        """The guidance scale [V] of each view of a window, in its order. given [V] bool; camera distances are in the
        unit of `cameras.scene_scale`. Raises ValueError for a window without a given view or an unknown guider."""
        if self.guider not in ("uniform", "multiview", "temporal"):
            raise ValueError(f"There is no guider {self.guider!r}: use uniform, multiview or temporal.")
        if not given.any():
            raise ValueError("A window needs at least one given view.")
        scales = torch.full((len(cameras),), self.scale, dtype=torch.float32)
        if self.guider == "uniform":
            return scales
        if self.guider == "temporal":
            position = torch.arange(len(cameras), dtype=torch.float32)
            steps = (position[:, None] - position[given][None]).abs().amin(1)
            scales = self.least + (self.scale - self.least) * steps / steps.max().clamp_min(1)
        return torch.where(_like_given(cameras, given), torch.tensor(self.least), scales)


def rotation_degrees(a: Cameras, b: Cameras) -> Tensor:
    """(len(a), len(b)) angles between the cameras' orientations, in degrees."""
    trace = torch.einsum("nij,mij->nm", a.rotation, b.rotation)
    return torch.rad2deg(torch.acos(((trace - 1) / 2).clamp(-1, 1)))


def _like_given(cameras: Cameras, given: Tensor) -> Tensor:
    """[V] bool: turned, placed and focused like given views; not necessarily like one of them in all three."""
    known = cameras[given]
    apart = torch.cdist(cameras.centers, known.centers, compute_mode="donot_use_mm_for_euclid_dist")
    unequal = (cameras.intrinsics[:, None] != known.intrinsics[None]).flatten(2).any(-1)
    turned = rotation_degrees(cameras, known).amin(1) < _NEAR_DEGREES
    return turned & (apart.amin(1) < _NEAR_DISTANCE) & ~unequal.all(1)
