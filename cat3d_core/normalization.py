"""The one similarity of a scene: it puts what the cameras look at at the origin, at distance 1, with +z up.

The same similarity serves the raymaps of every group and the field. (Other programs compute it anew for each chunk of
views, so that two chunks of one scene are in different units.)
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from cat3d_core.cameras import Cameras

# Optical axes must spread by this much (radians, rms) before their intersection is believed at all ...
MIN_CONVERGENCE = 0.05
# ... and by this much before it is believed more than known depths: cameras round an object stand at the object's
# distance, while the median depth of the points is that of the room.
STRONG_CONVERGENCE = 0.25
# Looked-at distance in units of the cameras' extent where nothing else is known (nearly parallel axes, no depth).
PARALLEL_DEPTH_FACTOR = 4.0


@dataclass(frozen=True)
class Similarity:
    """x -> scale * rotation @ x + translation. `method` says how it was found."""

    scale: float
    rotation: Tensor
    translation: Tensor
    method: str = "given"

    def points(self, x: Tensor) -> Tensor:
        """Map points (..., 3)."""
        return self.scale * x @ self.rotation.to(x).T + self.translation.to(x)

    def cameras(self, cameras: Cameras) -> Cameras:
        """Map camera poses; rotations stay rigid, only centres are scaled."""
        pose = cameras.world_from_camera.clone()
        pose[:, :3, :3] = self.rotation.to(pose) @ cameras.rotation
        pose[:, :3, 3] = self.points(cameras.centers)
        return Cameras(cameras.intrinsics, pose, cameras.size)

    def inverse(self) -> Similarity:
        """The similarity that undoes this one."""
        inverse_rotation = self.rotation.T
        return Similarity(
            1 / self.scale, inverse_rotation, -(inverse_rotation @ self.translation) / self.scale, self.method
        )


def normalize_scene(cameras: Cameras, points: Tensor | None = None, depth_bounds: Tensor | None = None) -> Similarity:
    """The similarity after which the looked-at point is the origin, the mean distance to it 1, and up is +z.

    cameras: the captured cameras (N >= 1), any frame. points (P, 3): sparse scene points in the same frame, if any.
    depth_bounds (N, 2): near and far z-depth per camera, if known. Works for one camera, for coincident and for
    collinear ones. The result moves with the world: normalising g(cameras) gives the same normalised cameras for
    every similarity g (points and depth bounds moved along).

    How the looked-at distance d is found, in this order:
      "convergence" the least-squares intersection of the optical axes, where they spread by STRONG_CONVERGENCE;
      "points"      the median depth of the points seen inside the images (at least 8 of them);
      "bounds"      the harmonic mean of near and far, median over cameras;
      "convergence" again, where the axes spread by MIN_CONVERGENCE;
      "extent"      PARALLEL_DEPTH_FACTOR times the rms distance of the cameras from their mean;
      "unit"        1 (a single camera, nothing known).
    Raises ValueError for no cameras or non-finite ones.
    """
    if len(cameras) == 0:
        raise ValueError("A scene without cameras cannot be normalised; give at least one captured view.")
    cams = cameras.to(dtype=torch.float64)
    if not (torch.isfinite(cams.world_from_camera).all() and torch.isfinite(cams.intrinsics).all()):
        raise ValueError("A camera has a NaN or infinite pose or intrinsics; the scene cannot be normalised.")
    mean_center = cams.centers.mean(0)
    extent = (cams.centers - mean_center).square().sum(-1).mean().sqrt()
    mean_forward = _mean_direction(cams.forward)

    depth, method = None, "unit"
    focus = axes_intersection(cams)
    strong = focus is not None and _axes_spread(cams.forward) > STRONG_CONVERGENCE
    if not strong and points is not None and len(points) >= 8:
        depth, method = _median_seen_depth(cams, points.double()), "points"
    if not strong and depth is None and depth_bounds is not None:
        depth, method = _bounds_depth(depth_bounds.double()), "bounds"
    if depth is not None:
        focus = None  # weakly converging axes put the looked-at point anywhere along them; the depth says where
    if depth is None:
        if focus is not None:
            depth, method = float((cams.centers - focus).norm(dim=-1).mean()), "convergence"
        # "extent" only when the cameras' spread is real and not rounding of their coordinates.
        elif extent > 1e-9 * (1 + cams.centers.abs().max()) and extent > 0:
            depth, method = PARALLEL_DEPTH_FACTOR * float(extent), "extent"
        else:
            depth, method = 1.0, "unit"
    if focus is None:
        focus = mean_center + depth * mean_forward
    rotation = _upright_frame(cams, mean_forward)
    scale = 1.0 / depth
    return Similarity(scale, rotation, -scale * rotation @ focus, method)


def axes_intersection(cameras: Cameras) -> Tensor | None:
    """(3,) the point nearest to all optical axes, or None where they don't converge in front of the cameras.

    Least squares: sum_i (I - f_i f_i^T)(x - c_i) = 0. Trusted when the axes spread by MIN_CONVERGENCE radians, four
    of five cameras have the point in front of them, and it lies near the axes (its distance to them is below half
    its distance to the cameras).
    """
    if len(cameras) < 2:
        return None
    centers, forward = cameras.centers.double(), cameras.forward.double()
    spread = _axes_spread(forward)
    off_axis = torch.eye(3, dtype=torch.float64, device=centers.device) - forward[:, :, None] * forward[:, None, :]
    system = off_axis.sum(0)
    if spread < MIN_CONVERGENCE or torch.linalg.cond(system) > 1e6:
        return None
    # Solved relative to the mean centre: far-away world origins cost no accuracy.
    mean_center = centers.mean(0)
    offset = torch.linalg.solve(system, (off_axis @ (centers - mean_center)[..., None]).sum(0)[:, 0])
    focus = mean_center + offset
    to_focus = focus - centers
    along = (to_focus * forward).sum(-1)
    beside = (to_focus - along[:, None] * forward).norm(dim=-1)
    distance = to_focus.norm(dim=-1)
    in_front = (along > 0).double().mean() >= 0.8
    return focus if in_front and beside.median() < 0.5 * distance.median() else None


def _axes_spread(forward: Tensor) -> Tensor:
    """Rms angle (radians) of viewing directions to their mean."""
    return torch.acos((forward @ _mean_direction(forward)).clamp(-1, 1)).square().mean().sqrt()


def _mean_direction(directions: Tensor) -> Tensor:
    """Mean of unit vectors, renormalised; the first one where they cancel."""
    mean = directions.mean(0)
    norm = mean.norm()
    return mean / norm if norm > 1e-6 else directions[0] / directions[0].norm()


def _median_seen_depth(cameras: Cameras, points: Tensor) -> float | None:
    pixels, depth = cameras.project(points)
    size = cameras.size[:, None].to(pixels)
    seen = (depth > 0) & (pixels >= 0).all(-1) & (pixels <= size).all(-1)
    medians = [depth[i][seen[i]].median() for i in range(len(cameras)) if seen[i].sum() >= 4]
    return float(torch.stack(medians).median()) if medians else None


def _bounds_depth(bounds: Tensor) -> float | None:
    usable = torch.isfinite(bounds).all(-1) & (bounds[:, 0] > 0) & (bounds[:, 1] >= bounds[:, 0])
    if not usable.any():
        return None
    near, far = bounds[usable].unbind(-1)
    return float((2 / (1 / near + 1 / far)).median())


def _upright_frame(cameras: Cameras, mean_forward: Tensor) -> Tensor:
    """(3, 3) rotation whose rows are the world axes x, y, z of the normalised frame: z up, y along the mean view."""
    up = _mean_direction(cameras.up)
    forward = mean_forward - (mean_forward @ up) * up
    if forward.norm() < 1e-3:  # looking straight along up: take the first camera's right as x instead
        right = cameras.rotation[0, :, 0] - (cameras.rotation[0, :, 0] @ up) * up
        right = right / right.norm()
    else:
        right = torch.linalg.cross(forward / forward.norm(), up)
    return torch.stack([right, torch.linalg.cross(up, right), up])
