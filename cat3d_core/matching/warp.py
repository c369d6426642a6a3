"""From a target's pixel and inverse depth to where a photo shows that point.

Image coordinates here are normalised: -1 and 1 are the outer edges of the image area, so that one projection serves
every resolution (`torch.nn.functional.grid_sample` with align_corners=False).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from cat3d_core.cameras import Cameras

# Image coordinates beyond this are clamped: far outside, whichever way.
_FAR = 4.0
# A point nearer to a photo's camera plane than this (times its depth in the target) is not seen by it.
_BEHIND = 1e-3
# Depths that differ by this share, plus this much inverse depth, are the same surface.
_SAME = (0.04, 0.004)


@dataclass(frozen=True)
class Views:
    """Cameras as networks take them: k (..., 3, 3) intrinsics in normalised image coordinates, pose (..., 4, 4)
    world_from_camera. Float64 where they come from `views`."""

    k: Tensor
    pose: Tensor

    def __getitem__(self, index: int | slice | Tensor | tuple[Tensor, ...]) -> Views:
        """The views of some rows."""
        return Views(self.k[index], self.pose[index])

    def to(self, device: torch.device | str) -> Views:
        """The views on another device."""
        return Views(self.k.to(device), self.pose.to(device))


def views(cameras: Cameras) -> Views:
    """N cameras of any sizes -> k (N, 3, 3), pose (N, 4, 4), float64."""
    size = cameras.size.double()
    scale = torch.zeros(len(cameras), 3, 3, dtype=torch.float64, device=size.device)
    scale[:, 0, 0], scale[:, 1, 1], scale[:, 2, 2] = 2 / size[:, 0], 2 / size[:, 1], 1
    scale[:, :2, 2] = -1
    return Views(scale @ cameras.intrinsics.double(), cameras.world_from_camera.double())


class Maps(NamedTuple):
    """The projective map of each pair of target and photo: for a target's pixel p = (x, y, 1) at inverse depth d, the
    photo's homogeneous pixel over the target's depth is turn @ p + shift * d. turn (N, M, 3, 3), shift (N, M, 3);
    baseline (N, M): distance of the two centres."""

    turn: Tensor
    shift: Tensor
    baseline: Tensor


def pair_maps(target: Views, photos: Views, dtype: torch.dtype = torch.float32) -> Maps:
    """target (N, ...), photos (N, M, ...): computed in float64, returned in `dtype`."""
    kt, pt, ks, ps = (x.double() for x in (target.k[:, None], target.pose[:, None], photos.k, photos.pose))
    relative = torch.linalg.inv(ps) @ pt
    turn = ks @ relative[..., :3, :3] @ torch.linalg.inv(kt)
    shift = (ks @ relative[..., :3, 3:])[..., 0]
    return Maps(turn.to(dtype), shift.to(dtype), relative[..., :3, 3].norm(dim=-1).to(dtype))


def pixel_grid(
    height: int, width: int, device: torch.device | None = None, dtype: torch.dtype = torch.float32
) -> Tensor:
    """(2, height, width) normalised coordinates x, y of the pixels' centres."""
    y = (torch.arange(height, device=device, dtype=dtype) + 0.5) / height * 2 - 1
    x = (torch.arange(width, device=device, dtype=dtype) + 0.5) / width * 2 - 1
    return torch.stack([x.expand(height, width), y[:, None].expand(height, width)])


class Projected(NamedTuple):
    """grid (N, M, K, h, w, 2) normalised coordinates in the photos; inverse_depth (N, M, K, h, w) in the photos' own
    cameras; valid (N, M, K, h, w) bool: in front of the photo's camera and inside its image."""

    grid: Tensor
    inverse_depth: Tensor
    valid: Tensor


def project(maps: Maps, inverse_depth: Tensor) -> Projected:
    """inverse_depth (N, K, h, w), >= 0: hypotheses at the pixels of N targets -> their places in M photos each."""
    n, count, h, w = inverse_depth.shape
    m = maps.turn.shape[1]
    xy = pixel_grid(h, w, inverse_depth.device, inverse_depth.dtype).reshape(2, -1)
    ray = maps.turn[..., :2] @ xy + maps.turn[..., 2:]  # (N, M, 3, h * w)
    d = inverse_depth.reshape(n, 1, count, h * w)
    x, y, z = (ray[:, :, i, None] + maps.shift[:, :, i, None, None] * d for i in range(3))
    front = z > _BEHIND
    z = z.clamp(min=_BEHIND)
    grid = torch.stack([x / z, y / z], -1).clamp(-_FAR, _FAR)
    valid = front & (grid.abs() <= 1).all(-1)
    shape = (n, m, count, h, w)
    return Projected(grid.reshape(*shape, 2), (d / z).reshape(shape), valid.reshape(shape))


def take(maps: Tensor, grid: Tensor, mode: str = "bilinear") -> Tensor:
    """Read photos at places: maps (B, C, H, W), grid (B, K, h, w, 2) -> (B, C, K, h, w) in the grid's dtype; outside
    the image the border's values."""
    count, h = grid.shape[1:3]
    flat = grid.flatten(1, 2)
    out = F.grid_sample(maps.to(grid.dtype), flat, mode=mode, padding_mode="border", align_corners=False)
    return out.unflatten(2, (count, h))


def agreeing(depth: Tensor, target: Views, photo_depth: Tensor, photos: Views, which: Tensor) -> Tensor:
    """(N, M, H, W) bool: whether photo `which[n, m]` shows what target n does at each pixel: the place lies in its
    image, at the depth that it has there.

    depth (N, H, W) of the targets (N) and photo_depth (B, h, w) of the photos (B) are inverse, in the cameras' unit."""
    at = project(pair_maps(target, photos[which]), depth[:, None])
    there = take(photo_depth[which.flatten()][:, None], at.grid.flatten(0, 1), "nearest")
    there, here = there.unflatten(0, which.shape)[:, :, 0, 0], at.inverse_depth[:, :, 0]
    return at.valid[:, :, 0] & ((there - here).abs() < _SAME[0] * here + _SAME[1])
