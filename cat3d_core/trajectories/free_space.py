"""Keeping cameras out of geometry and away from angles the captured views don't support."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from cat3d_core.cameras import Cameras
from cat3d_core.random import generator
from cat3d_core.trajectories.frame import SceneFrame
from cat3d_core.view_selection import farthest_points

_MAX_POINTS = 10_000
_MAX_VIEWS = 24
_GRID = 24  # cells per image side of the coarse farthest-depth maps
_NEIGHBOUR = 5  # so many points make a surface: sparse points have lone outliers
CLEARANCE = 0.12  # least distance from a camera to the surface, in units of the scene's distance
_BEHIND = 0.25  # how far behind a seen surface still counts as inside it, same unit
_ELEVATION_MARGIN = 12.0  # degrees above and below the captured elevations
_MAX_ELEVATION = 80.0
_ADVANCE = 0.5  # how much of the way to the nearest surface a camera may go, for views that look one way


@dataclass(frozen=True)
class FreeSpace:
    """What the captured views say about where a camera may stand.

    points (P, 3): scene points, maybe none. farthest (V, g, g): depth of the farthest point seen in each cell of
    captured views, -inf where none. elevation: lowest and highest elevation in degrees of the captured views about the
    centre. advance: farthest a camera may be ahead of the captured ones along the mean view (world unit).
    """

    frame: SceneFrame
    captured: Cameras
    points: Tensor
    farthest: Tensor
    views: Cameras
    elevation: tuple[float, float]
    advance: float

    @staticmethod
    def of(captured: Cameras, frame: SceneFrame, points: Tensor | None, seed: int = 0) -> FreeSpace:
        """Measure captured views (N) and points (P, 3) or None. More than 10,000 points are sampled by the seed."""
        if points is None:
            points = captured.centers.new_zeros(0, 3)
        if len(points) > _MAX_POINTS:
            pick = torch.randperm(len(points), generator=generator(seed, "plan", "points"))[:_MAX_POINTS]
            points = points[pick.to(points.device)]
        some = farthest_points(captured, min(_MAX_VIEWS, len(captured)), frame.distance)
        views = captured[some]
        heights = _elevation(frame, captured.centers)
        along = (captured.centers @ frame.forward).max()
        return FreeSpace(
            frame,
            captured,
            points,
            _farthest_depths(views, points),
            views,
            (max(float(heights.min()) - _ELEVATION_MARGIN, -_MAX_ELEVATION), float(heights.max()) + _ELEVATION_MARGIN),
            float(along) + _ADVANCE * frame.near,
        )

    def blocked(self, centers: Tensor) -> Tensor:
        """(N,) whether positions (N, 3) are within CLEARANCE of the surface or inside a seen surface.

        Inside: behind the farthest point of its cell, by less than a quarter of the scene's distance, in every captured
        view that has points there (and one at least has). Without points nothing is blocked.
        """
        if len(self.points) < _NEIGHBOUR:
            return torch.zeros(len(centers), dtype=torch.bool, device=centers.device)
        # Local coordinates: the products inside cdist lose no digits to a far-away world origin.
        surface, places = self.frame.local(self.points), self.frame.local(centers)
        close = torch.cat([(torch.cdist(p, surface) < CLEARANCE).sum(1) >= _NEIGHBOUR for p in places.split(64)])
        depth, reach, known = self._compare(centers)
        inside = known & (depth > reach) & (depth < reach + _BEHIND * self.frame.distance)
        return close | (inside.any(0) & (inside | ~known).all(0))

    def unusual(self, centers: Tensor, round_the_scene: bool) -> Tensor:
        """(N,) whether positions leave the captured elevations (paths round the scene) or go too far in (others)."""
        if not round_the_scene:
            return centers @ self.frame.forward > self.advance
        height = _elevation(self.frame, centers)
        low, high = self.elevation
        return (height < low - 1e-6) | (height > min(high, max(_MAX_ELEVATION, high - _ELEVATION_MARGIN)) + 1e-6)

    def retreat(self, centers: Tensor) -> Tensor:
        """Blocked positions moved in quarter steps to the nearest captured camera, where space is known to be free."""
        home = self.captured.centers[torch.cdist(centers, self.captured.centers).argmin(1)]
        moved, todo = centers.clone(), self.blocked(centers)
        for step in (0.25, 0.5, 0.75, 1.0):
            if not todo.any():
                break
            moved[todo] = (1 - step) * centers[todo] + step * home[todo]
            todo = todo & self.blocked(moved)
        return moved

    def _compare(self, centers: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Depth of each position in each view (V, N), the farthest surface in its cell, and whether there is one."""
        pixels, depth = self.views.project(centers)
        cell = _cells(self.views, pixels)
        inside = (depth > 0) & (cell >= 0)
        reach = self.farthest.flatten(1).gather(1, cell.clamp(min=0))
        return depth, reach, inside & torch.isfinite(reach)


def _cells(views: Cameras, pixels: Tensor) -> Tensor:
    """(V, N) cell number of pixels (V, N, 2), -1 outside the image."""
    ij = torch.nan_to_num(pixels / views.size[:, None].to(pixels) * _GRID, nan=-1.0).clamp(-1, _GRID).floor().long()
    inside = ((ij >= 0) & (ij < _GRID)).all(-1)
    return torch.where(inside, ij[..., 1] * _GRID + ij[..., 0], -1)


def _farthest_depths(views: Cameras, points: Tensor) -> Tensor:
    out = torch.full((len(views), _GRID * _GRID), -torch.inf, dtype=views.centers.dtype, device=views.centers.device)
    if len(points):
        pixels, depth = views.project(points.to(views.centers))
        cell = _cells(views, pixels)
        cell = torch.where(depth > 0, cell, -1)
        value = torch.where(cell >= 0, depth, -torch.inf)
        out = out.scatter_reduce(1, cell.clamp(min=0), value, "amax")
    return out.reshape(len(views), _GRID, _GRID)


def _elevation(frame: SceneFrame, centers: Tensor) -> Tensor:
    x, y, z = frame.local(centers).unbind(-1)
    return torch.rad2deg(torch.atan2(z, torch.hypot(x, y)))
