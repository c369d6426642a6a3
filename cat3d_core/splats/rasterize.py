"""Images of Gaussians, by the fastest rasteriser that there is."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import normalize

from cat3d_core.cameras import Cameras
from cat3d_core.reconstruction.render import Render
from cat3d_core.splats import rasterize_cpu, rasterize_gsplat, reference
from cat3d_core.splats.gaussians import Gaussians
from cat3d_core.splats.reference import Raster, Window

FAR = 1e6
"""Depth (scene units) of pixels that show nothing, as a field's."""
GREY = 0.5
"""What renders show behind the Gaussians, as a field's."""


def rasterize(
    gaussians: Gaussians,
    camera: Cameras,
    window: Window | None = None,
    antialias: bool = True,
    features: Tensor | None = None,
) -> Raster:
    """The Gaussians (float32) in one camera (a batch of one): their colours, or other `features` (N, C).

    On the CPU the C++ kernels where a compiler is found (float64 too), on CUDA gsplat where it is installed, else the
    plain torch reference, for which images have to be small. Differentiable in everything but the camera.
    """
    camera = camera.to(gaussians.means.device, gaussians.means.dtype)
    if features is None:
        features = gaussians.colours(camera.centers[0])
    inputs = (gaussians.means, gaussians.quaternions, gaussians.scales, gaussians.opacities, features)
    device = gaussians.means.device.type
    if device == "cpu" and rasterize_cpu.available() and features.shape[1] in rasterize_cpu.CHANNELS:
        return rasterize_cpu.rasterize(*inputs, camera, window, antialias)
    if device == "cuda" and rasterize_gsplat.available() and not camera.intrinsics[0, 0, 1]:
        return rasterize_gsplat.rasterize(*inputs, camera, window, antialias)
    return reference.rasterize(*inputs, camera, window, antialias)


@torch.no_grad()
def render(gaussians: Gaussians, cameras: Cameras, index: int, scale: float = 1.0, antialias: bool = True) -> Render:
    """One camera's view at `scale` times its size, before grey: colour, median and mean depth, opacity, and as normals
    the Gaussians' shortest axes, averaged."""
    width, height = (max(1, round(float(side) * scale)) for side in cameras.size[index])
    camera = cameras[index].to(gaussians.means.device, gaussians.means.dtype).resize(width, height)
    centre = camera.centers[0]
    features = torch.cat([gaussians.colours(centre), gaussians.normals(centre)], 1)
    raster = rasterize(gaussians, camera, antialias=antialias, features=features)
    opacity = raster.opacity.clamp(0.0, 1.0)
    tiny = torch.finfo(opacity.dtype).tiny
    mean = torch.where(opacity > 0, raster.depth / opacity.clamp_min(tiny), FAR)
    colour, normals = raster.features.permute(1, 2, 0).split(3, -1)
    return Render(
        image=(colour + (1.0 - opacity)[..., None] * GREY).clamp(0.0, 1.0),
        depth=torch.where(raster.median.isfinite(), raster.median, mean),
        depth_mean=mean,
        opacity=opacity,
        normals=normalize(normals, dim=-1, eps=tiny),
    )
