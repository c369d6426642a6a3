"""The rasteriser of gsplat (Apache-2.0) on CUDA, where it is installed."""

from __future__ import annotations

import functools
import importlib.util

import torch
from torch import Tensor

from cat3d_core.cameras import Cameras
from cat3d_core.splats.reference import BLUR, NEAR, Raster, Window, whole


@functools.cache
def available() -> bool:
    """Whether gsplat is installed and there is a CUDA device."""
    return torch.cuda.is_available() and importlib.util.find_spec("gsplat") is not None


def rasterize(
    means: Tensor, quaternions: Tensor, scales: Tensor, opacities: Tensor, features: Tensor,
    camera: Cameras, window: Window | None = None, antialias: bool = True,
) -> Raster:  # fmt: skip
    """As `reference.rasterize`, up to gsplat's own cuts; `median` is the mean depth, which is what gsplat gives."""
    from gsplat import rasterization

    x0, y0, width, height = window or whole(camera)
    seen = camera.crop(x0, y0, width, height)
    out, alpha, _ = rasterization(
        means, quaternions, scales, opacities, features, seen.camera_from_world, seen.intrinsics, width, height,
        near_plane=NEAR, eps2d=BLUR, packed=False, render_mode="RGB+D",
        rasterize_mode="antialiased" if antialias else "classic",
    )  # fmt: skip
    image, opacity = out[0].permute(2, 0, 1), alpha[0, ..., 0]
    depth = image[-1]
    mean = (depth / opacity.clamp_min(torch.finfo(opacity.dtype).tiny)).detach()
    return Raster(image[:-1], depth, opacity, torch.where(opacity > 0.5, mean, torch.inf))
