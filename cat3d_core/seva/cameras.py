"""The cameras as SEVA's network takes them: one scale for the scene, rays relative to a window's first view.

Its own code takes another scale for each window; here the scale is that of the scene's first captured view, so that
all windows speak of one scene in one unit.
"""

from __future__ import annotations

import torch
from torch import Tensor

from cat3d_core.cameras import Cameras
from cat3d_core.normalization import Similarity
from cat3d_core.rays import raymap

#: Distance of the reference camera from the middle of all cameras after scaling.
CAMERA_SCALE = 2.0
_OUTLIER, _QUANTILE, _FARTHEST = 10.0, 0.97, 1e6


def scene_scale(cameras: Cameras, reference: int = 0, camera_scale: float = CAMERA_SCALE) -> Similarity:
    """The similarity that puts the middle of all the scene's cameras (N captured and planned ones) at the origin and
    the one with this index at `camera_scale` from it.

    Where the reference stands in the middle (to 1e-5) the unit itself is scaled instead. Raises ValueError for no
    cameras.
    """
    if not len(cameras):
        raise ValueError("A scene without cameras has no scale; give at least one captured view.")
    middle = scene_middle(cameras.centers)
    far = float((cameras.centers[reference] - middle).norm())
    scale = camera_scale if far <= 1e-5 else camera_scale / far
    return Similarity(scale, torch.eye(3).to(middle), -scale * middle, "seva")


def scene_middle(centers: Tensor) -> Tensor:
    """Mean [3] of the camera centres [N, 3] that are not farther from their median than 10 times the distance that 97%
    of them keep."""
    distance = (centers - centers.median(0).values).norm(dim=-1)
    limit = min(_OUTLIER * float(torch.quantile(distance, _QUANTILE)), _FARTHEST)
    return centers[distance <= limit].mean(0)


def rays(cameras: Cameras, height: int, width: int) -> Tensor:
    """Plücker coordinates (unit direction d, origin x d) [V, 6, height, width] of each place of the latents of one
    window's cameras, in the frame of the first of them. Distances are in the cameras' unit: scale them before."""
    moments, directions = raymap(cameras, cameras.world_from_camera[0], height, width, plucker=True).split(3, dim=1)
    return torch.cat([directions, moments], 1)
