"""Carrying a photo into another camera whose depth is known, where the photo shows the same place."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from cat3d_core.cameras import Cameras
from cat3d_core.rays import image_rays

#: Depths that differ by less than this share are of one surface.
TOLERANCE = 0.03
#: Where nothing was hit: far away, not nowhere.
_FAR = 1e4


def warp(
    photos: Sequence[Tensor], photo_depths: Sequence[Tensor], cameras: Cameras, target: Cameras, depth: Tensor
) -> tuple[Tensor, Tensor]:
    """The image (3, H, W) that the photos (best first) make of a target camera, and where one shows it (H, W) bool.

    photos: (3, h, w) in [0, 1] each, of `cameras`; photo_depths: (h', w') z-depth of the same pictures at any
    resolution; target: one camera, whose z-depth is depth (H, W). Depths that aren't finite are far away. A photo shows
    a place where that lies in its picture at the depth it has there (to 3%); the rest is black.
    """
    height, width = depth.shape
    far = torch.where(depth.isfinite(), depth, torch.full_like(depth, _FAR)).double().reshape(-1, 1)
    rays = image_rays(target.to(dtype=torch.float64), 0, width, height)
    pixels, z = cameras.to(dtype=torch.float64).project(rays.origins + far * rays.directions)
    image, seen = torch.zeros(3, height * width), torch.zeros(height * width, dtype=torch.bool)
    for source, (photo, there) in enumerate(zip(photos, photo_depths, strict=True)):
        grid = (pixels[source] / cameras.size[source] * 2 - 1).float()[None, :, None]
        reached = F.grid_sample(
            torch.nan_to_num(there.float(), nan=_FAR, posinf=_FAR)[None, None], grid, mode="nearest",
            align_corners=False,
        )[0, 0, :, 0]  # fmt: skip
        inside = (grid[0, :, 0].abs() <= 1).all(-1) & (z[source] > 0)
        new = inside & ((reached - z[source]).abs() < TOLERANCE * z[source]) & ~seen
        colour = F.grid_sample(photo[None], grid, align_corners=False, padding_mode="border")[0, :, :, 0]
        image[:, new], seen = colour[:, new], seen | new
    return image.reshape(3, height, width), seen.reshape(height, width)
