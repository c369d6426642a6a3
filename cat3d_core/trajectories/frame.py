"""Where a scene is, seen from its captured cameras: centre, up, mean viewing direction, distance, nearest surface."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from cat3d_core.cameras import Cameras
from cat3d_core.normalization import normalize_scene

# Weight of 'up is the mean of the cameras' ups' against 'cameras are held level', in units of squared sine.
_UP_PRIOR = 0.02
# Points in the outer image this much deeper than in its middle: there is a central object.
CENTRAL_OBJECT = 1.6


@dataclass(frozen=True)
class SceneFrame:
    """The scene as trajectories need it, in the cameras' own world frame and unit.

    center (3,): the looked-at point. up (3,): unit, against gravity. forward (3,): unit mean viewing direction.
    right (3,), ahead (3,): unit, horizontal; ahead is forward's horizontal part. distance: mean from the cameras to
    the centre. near: depth of the nearest surface in front of the cameras. scale_known: False where the distance is
    a convention only (one camera, no depth). Nothing of it depends on where the world's origin or axes are.
    """

    center: Tensor
    up: Tensor
    forward: Tensor
    right: Tensor
    ahead: Tensor
    distance: float
    near: float
    scale_known: bool = True

    @property
    def axes(self) -> Tensor:
        """(3, 3) rows right, ahead, up: takes world directions into the scene's upright axes."""
        return torch.stack([self.right, self.ahead, self.up])

    def local(self, points_world: Tensor) -> Tensor:
        """World points (..., 3) -> right, ahead, up coordinates about the centre, in units of `distance`."""
        return (points_world - self.center) @ self.axes.T / self.distance


def scene_frame(
    cameras: Cameras,
    points: Tensor | None = None,
    depth_bounds: Tensor | None = None,
    pitch_down_deg: float = 0.0,
) -> SceneFrame:
    """Centre, up, directions and distances of the scene that the cameras look at.

    cameras: N >= 1 captured views; points (P, 3) sparse scene points; depth_bounds (N, 2) near and far z-depth.
    pitch_down_deg: how far a single camera looks down; it can't be seen from one pose, and an orbit needs it.
    The centre is that of `normalize_scene`, or, for a single view of a central object, that object. Raises ValueError
    where `normalize_scene` does.
    """
    cams = cameras.to(dtype=torch.float64)
    similarity = normalize_scene(cams, points, depth_bounds)
    center = similarity.inverse().translation.to(cams.centers)
    middle = central_object(cams, points)
    if middle is not None and middle[0] > CENTRAL_OBJECT:
        center = cams.centers[0] + middle[1] * cams.forward[0]
    # Measured, not 1 / scale: with points that is their median depth, which in a room is far behind the object.
    distance = float((cams.centers - center).norm(dim=-1).mean())
    up = estimate_up(cams)
    if len(cams) == 1:
        tilt = torch.tensor(pitch_down_deg, dtype=torch.float64).deg2rad()
        up = tilt.cos() * up - tilt.sin() * cams.forward[0]
    forward = _unit(cams.forward.mean(0), cams.forward[0])
    level = forward - (forward @ up) * up
    # Looking straight down or up: 'ahead' is then where the tops of the images point.
    ahead = level if level.norm() > 1e-3 else cams.up[0] - (cams.up[0] @ up) * up
    ahead = ahead / ahead.norm()
    near = _near_depth(cams, points, depth_bounds)
    return SceneFrame(
        center=center,
        up=up,
        forward=forward,
        right=torch.linalg.cross(ahead, up),
        ahead=ahead,
        distance=distance,
        near=min(near, distance) if near is not None else 0.5 * distance,
        scale_known=similarity.method != "unit",
    )


def estimate_up(cameras: Cameras) -> Tensor:
    """(3,) unit direction against gravity, from how cameras are held: level (right axis horizontal), top side up.

    Smallest eigenvector of mean(r r^T) + lambda (I - m m^T), r the right axes, m the mean of the image-up axes. Where
    views turn about the vertical the first term fixes it, however far they look down (there the mean of the ups is
    tilted); where all look the same way the second does.
    """
    cams = cameras.to(dtype=torch.float64)
    right = cams.rotation[:, :, 0]
    eye = torch.eye(3, dtype=torch.float64, device=right.device)
    moment = right.T @ right / len(right)
    mean_up = cams.up.mean(0)
    if mean_up.norm() > 1e-3:
        m = mean_up / mean_up.norm()
        moment = moment + _UP_PRIOR * (eye - torch.outer(m, m))
    up = torch.linalg.eigh(moment).eigenvectors[:, 0]
    # Ups that cancel belong to views straight down (or up) all round: down is taken, the usual one.
    sense = mean_up @ up if mean_up.norm() > 1e-3 else -cams.forward.mean(0) @ up
    return up if sense >= 0 else -up


def central_object(cameras: Cameras, points: Tensor | None) -> tuple[float, float] | None:
    """For one view: how many times deeper the points in the image's border are than those in its middle third, and
    the median depth of the latter. None for several views or fewer than 8 points in either part."""
    if len(cameras) != 1 or points is None or len(points) < 8:
        return None
    pixels, depth = cameras.project(points.to(cameras.centers))
    place = ((pixels[0] / cameras.size.to(pixels)) * 2 - 1).abs().amax(-1)
    middle = depth[0][(depth[0] > 0) & (place < 1 / 3)]
    border = depth[0][(depth[0] > 0) & (place > 2 / 3) & (place <= 1)]
    if len(middle) < 8 or len(border) < 8:
        return None
    return float(border.median() / middle.median()), float(middle.median())


def look_at(centers: Tensor, targets: Tensor, up: Tensor, right_hint: Tensor) -> Tensor:
    """Poses (N, 4, 4) at centers (N, 3) whose forward axis points to targets (N, 3) or (3,), image top towards `up`.

    up (3,) unit. right_hint (3,): the image's right for cameras that look along `up`, where that leaves it open.
    A camera at its target looks horizontally ahead (along up x right_hint).
    """
    offset = targets - centers
    length = offset.norm(dim=-1, keepdim=True)
    ahead = torch.linalg.cross(up, right_hint)
    forward = torch.where(length > 1e-12, offset / length.clamp(min=1e-300), ahead.expand_as(offset))
    right = torch.linalg.cross(forward, up.expand_as(forward))
    size = right.norm(dim=-1, keepdim=True)
    hint = right_hint - (forward @ right_hint)[:, None] * forward
    right = torch.where(size > 1e-6, right, hint)
    right = right / right.norm(dim=-1, keepdim=True)
    return poses(torch.stack([right, torch.linalg.cross(forward, right), forward], -1), centers)


def poses(rotations: Tensor, centers: Tensor) -> Tensor:
    """(N, 4, 4) from rotations (N, 3, 3) and centres (N, 3)."""
    out = torch.zeros(len(centers), 4, 4, dtype=centers.dtype, device=centers.device)
    out[:, :3, :3], out[:, :3, 3], out[:, 3, 3] = rotations, centers, 1
    return out


def _unit(v: Tensor, otherwise: Tensor) -> Tensor:
    return v / v.norm() if v.norm() > 1e-6 else otherwise


def _near_depth(cameras: Cameras, points: Tensor | None, depth_bounds: Tensor | None) -> float | None:
    """Depth of the nearest surface: 2% quantile of seen points (sparse points have outliers), or the least bound."""
    if points is not None and len(points) >= 8:
        pixels, depth = cameras.project(points.double())
        seen = (depth > 0) & (pixels >= 0).all(-1) & (pixels <= cameras.size[:, None]).all(-1)
        if seen.any():
            ordered = depth[seen].sort().values
            return float(ordered[int(0.02 * (len(ordered) - 1))])
    if depth_bounds is not None:
        near = depth_bounds[:, 0].double()
        near = near[torch.isfinite(near) & (near > 0)]
        if len(near):
            return float(near.min())
    return None
