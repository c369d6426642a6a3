"""How well a set of views sees the scene's volume: a voxel grid of viewing directions.

Definition. The volume is a cube about the scene's centre, upright, with a side of 1.5 times the mean distance of the
captured cameras; where scene points are known, only the voxels that hold some of them (and their neighbours) count,
else all of them. A voxel is seen by a view when its middle projects into the image at positive depth; there is no
occlusion test (sparse points cannot give one). The unit directions from voxel to camera are sorted into 128 bins of
equal solid angle: 8 equal bands of the upward component times 16 equal sectors of azimuth (bands of equal height on
the sphere have equal areas). A (voxel, bin) pair is covered when some view sees the voxel from that bin. So the
measure moves with the world and has no unit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from cat3d_core.cameras import Cameras
from cat3d_core.trajectories.frame import SceneFrame

_BANDS, _SECTORS = 8, 16
BINS = _BANDS * _SECTORS
_SIDE = 1.5
_NONE = -1


@dataclass(frozen=True)
class Coverage:
    """Numbers of one set of views: seen, the fraction of voxels that any view sees; directions, the mean number of
    the 128 direction bins a voxel is seen from (over all voxels)."""

    seen: float
    directions: float


def voxel_grid(frame: SceneFrame, points: Tensor | None = None, resolution: int = 12) -> Tensor:
    """(K, 3) world middles of the voxels that count, in fixed order. See the module for the definition."""
    step = _SIDE / resolution
    axis = (torch.arange(resolution, dtype=torch.float64) + 0.5) * step - _SIDE / 2
    local = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    if points is not None and len(points):
        cell = ((frame.local(points.to(frame.center)) + _SIDE / 2) / step).floor().long()
        cell = cell[((cell >= 0) & (cell < resolution)).all(-1)]
        occupied = torch.zeros((resolution,) * 3)
        occupied[tuple(cell.T)] = 1
        near = torch.nn.functional.max_pool3d(occupied[None, None], 3, stride=1, padding=1)[0, 0]
        if near.any():
            local = local[near.reshape(-1) > 0]
    return frame.center + frame.distance * local @ frame.axes


def direction_bins(cameras: Cameras, frame: SceneFrame, voxels: Tensor) -> Tensor:
    """(N, K) int64: the bin that view n sees voxel k from, or -1 where it does not see it."""
    out = []
    for i in range(0, len(cameras), 32):
        some = cameras[slice(i, i + 32)]
        seen = _sees(some, voxels)
        toward = (some.centers[:, None] - voxels[None]) @ frame.axes.T
        out.append(torch.where(seen, bin_of(toward), _NONE))
    return torch.cat(out) if out else torch.zeros(0, len(voxels), dtype=torch.long)


def bin_of(directions: Tensor) -> Tensor:
    """(...) int64 bin of directions (..., 3) in right, ahead, up axes; they need not have unit length."""
    x, y, z = directions.unbind(-1)
    height = z / directions.norm(dim=-1).clamp(min=1e-300)
    band = ((height + 1) / 2 * _BANDS).long().clamp(0, _BANDS - 1)
    sector = ((torch.atan2(y, x) / (2 * torch.pi) + 0.5) * _SECTORS).long().clamp(0, _SECTORS - 1)
    return band * _SECTORS + sector


def coverage(bins: Tensor) -> Coverage:
    """Coverage of views given their bins (N, K)."""
    covered = _covered(bins)
    return Coverage(float(covered.any(-1).double().mean()), float(covered.sum(-1).double().mean()))


def gains(bins: Tensor, given: Tensor | None = None) -> Tensor:
    """(N,) how many (voxel, bin) pairs each view adds to those before it in order and to `given` (G, K)."""
    covered = _covered(given) if given is not None else torch.zeros(bins.shape[1], BINS, dtype=torch.bool)
    added = []
    voxel = torch.arange(bins.shape[1])
    for row in bins:
        k = voxel[row >= 0]
        b = row[row >= 0]
        added.append(int((~covered[k, b]).sum()))
        covered[k, b] = True
    return torch.tensor(added, dtype=torch.long)


def seen_from_nearby(views: Cameras, given: Cameras, voxels: Tensor, angle_deg: float) -> Tensor:
    """(N,) which share of the voxels (K, 3) that a view sees, some given camera sees from at most `angle_deg` beside it
    (the angle at the voxel between the directions to both); 1 for a view that sees none. Distances do not count."""

    def directions(cameras: Cameras) -> tuple[Tensor, Tensor]:
        toward = torch.nn.functional.normalize(cameras.centers[:, None] - voxels[None], dim=-1)
        return toward, _sees(cameras, voxels)

    known, known_seen = directions(given)
    out = []
    for i in range(0, len(views), 16):
        toward, seen = directions(views[slice(i, i + 16)])
        cosine = torch.einsum("nkd,vkd->nvk", toward, known).masked_fill(~known_seen, -1).amax(1)
        near = cosine >= math.cos(math.radians(angle_deg))
        out.append((near & seen).sum(1) / seen.sum(1).clamp(min=1) + (~seen.any(1)).double())
    return torch.cat(out)


def _sees(cameras: Cameras, voxels: Tensor) -> Tensor:
    """(N, K) whether the middle of voxel k is in the image of camera n, at positive depth."""
    pixels, depth = cameras.project(voxels)
    return (depth > 0) & (pixels >= 0).all(-1) & (pixels <= cameras.size[:, None].to(pixels)).all(-1)


def _covered(bins: Tensor) -> Tensor:
    """(K, BINS) which pairs any of the views covers."""
    out = torch.zeros(bins.shape[1], BINS + 1, dtype=torch.bool)
    out[torch.arange(bins.shape[1]).expand_as(bins), bins] = True  # -1 is the spare last column
    return out[:, :BINS]
