"""Projection and rasterisation of Gaussians in plain torch: every formula in one place, any dtype, differentiable.

Elliptical weighted averages (Zwicker et al. 2001) as in 3D Gaussian splatting (Kerbl et al. 2023): the image of a
Gaussian is that of its covariance under the projection linearised at its mean; images are put over one another in the
order of the means' z-depth. `splats.cpp` computes the same; here memory is that of every pixel times every Gaussian.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from cat3d_core.cameras import Cameras
from cat3d_core.quaternions import rotation_matrices

NEAR = 0.01
"""Gaussians whose means are nearer (z-depth, scene units) are not drawn: the linearised projection ends there."""
BLUR = 0.3
"""Variance (pixels^2) that is added to each image, so that none is thinner than a pixel."""
LEAST_RATIO = 2.5e-5
"""Smallest ratio of areas squared before and after that blur; below it the opacity falls no further."""
STEEPEST = 1.5
"""The projection is linearised at x/z and y/z of at most this (56 degrees), beyond which it would tear images out to
any length. Independent of the image's size, so that a part of an image looks like the same part of the whole."""
LEAST_ALPHA = 1.0 / 255.0
MOST_ALPHA = 0.999
LEAST_LIGHT = 1e-4
"""What less than this share of the light reaches is not drawn."""


class Window(NamedTuple):
    """A rectangle of a camera's image, in whole pixels."""

    x0: int
    y0: int
    width: int
    height: int


class Raster(NamedTuple):
    """features (C, H, W): sums over the Gaussians of weight times feature; depth (H, W): of weight times z-depth of the
    mean; opacity (H, W): of weights; median (H, W): z-depth of the Gaussian at which half of the light is gone, inf
    where it never is (carries no gradient)."""

    features: Tensor
    depth: Tensor
    opacity: Tensor
    median: Tensor


class Composite(NamedTuple):
    """The images; alpha before it is cut and the light left behind each Gaussian (pixels, N), nearest first; the
    Gaussians' depths (N,)."""

    raster: Raster
    alpha: Tensor
    light: Tensor
    depth: Tensor


class Projected(NamedTuple):
    """centre (N, 2) in pixels; conic (N, 3): a, b, c of 1/2 (a dx^2 + c dy^2) + b dx dy; opacity (N,); depth
    (N,)."""

    centre: Tensor
    conic: Tensor
    opacity: Tensor
    depth: Tensor


def whole(camera: Cameras) -> Window:
    """The window that is all of a camera's image."""
    width, height = (int(side) for side in camera.size[0])
    return Window(0, 0, width, height)


def project(
    means: Tensor, quaternions: Tensor, scales: Tensor, opacities: Tensor, camera: Cameras, antialias: bool = True
) -> Projected:
    """Images of N Gaussians in one camera (a batch of one, in their dtype).

    antialias: opacities fall as the blur spreads an image out (Mip-Splatting, Yu et al. 2024, eq. 9), so that a
    Gaussian covers the same at any size of the image; otherwise it is drawn as by the first 3DGS programs.
    """
    pose, k = camera.camera_from_world[0], camera.intrinsics[0]
    view = means @ pose[:3, :3].T + pose[:3, 3]
    depth = view[:, 2]
    safe = torch.where(depth > NEAR, depth, 1.0)
    ratio = view[:, :2] / safe[:, None]
    x, y = ratio.clamp(-STEEPEST, STEEPEST).unbind(1)
    zero = torch.zeros_like(x)
    fx, skew, fy = k[0, 0].expand_as(x), k[0, 1].expand_as(x), k[1, 1].expand_as(x)
    jacobian = torch.stack([fx, skew, -(fx * x + skew * y), zero, fy, -fy * y], -1).view(-1, 2, 3) / safe[:, None, None]
    factor = jacobian @ pose[:3, :3] @ rotation_matrices(quaternions) * scales[:, None, :]
    xx, yy = factor.square().sum(-1).unbind(-1)
    xy = (factor[:, 0] * factor[:, 1]).sum(-1)
    # The determinant as a sum of squares (Cauchy-Binet): nothing cancels, however thin the image is.
    sharp = torch.linalg.cross(factor[:, 0], factor[:, 1]).square().sum(-1)
    determinant = sharp + BLUR * (xx + yy) + BLUR * BLUR
    conic = torch.stack([yy + BLUR, -xy, xx + BLUR], -1) / determinant[:, None]
    centre = torch.stack([fx * ratio[:, 0] + skew * ratio[:, 1], fy * ratio[:, 1]], -1) + k[:2, 2]
    if antialias:
        opacities = opacities * (sharp / determinant).clamp_min(LEAST_RATIO).sqrt()
    return Projected(centre, conic, opacities, depth)


def rasterize(
    means: Tensor,
    quaternions: Tensor,
    scales: Tensor,
    opacities: Tensor,
    features: Tensor,
    camera: Cameras,
    window: Window | None = None,
    antialias: bool = True,
) -> Raster:
    """The images of N Gaussians with features (N, C), put over one another, nearest first, over nothing (0)."""
    return composite(means, quaternions, scales, opacities, features, camera, window, antialias).raster


def composite(
    means: Tensor,
    quaternions: Tensor,
    scales: Tensor,
    opacities: Tensor,
    features: Tensor,
    camera: Cameras,
    window: Window | None = None,
    antialias: bool = True,
) -> Composite:
    """`rasterize`, with what its cuts were made by."""
    x0, y0, width, height = window or whole(camera)
    flat = project(means, quaternions, scales, opacities, camera, antialias)
    shown = flat.depth.detach() > NEAR
    order = flat.depth.detach().argsort(stable=True)
    order = order[shown[order]]
    centre, conic, opacity, depth = (value[order] for value in flat)
    y, x = torch.meshgrid(torch.arange(height) + 0.5 + y0, torch.arange(width) + 0.5 + x0, indexing="ij")
    pixel = torch.stack([x, y], -1).reshape(-1, 1, 2).to(means)
    dx, dy = (pixel - centre).unbind(-1)
    a, b, c = conic.unbind(-1)
    raw = opacity * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
    alpha = torch.where(raw >= LEAST_ALPHA, raw.clamp_max(MOST_ALPHA), 0.0)  # (pixels, N)
    light = (1 - alpha).cumprod(1)
    reached = light >= LEAST_LIGHT
    before = torch.cat([torch.ones_like(light[:, :1]), light[:, :-1]], 1)
    weight = alpha * before * reached
    half = (light <= 0.5) & reached
    found = half.any(1)
    median = torch.where(found, depth[half.to(torch.uint8).argmax(1)] if len(depth) else 0.0, math.inf).detach()
    shape = (height, width)
    raster = Raster(
        (weight @ features[order]).T.reshape(-1, *shape),
        (weight @ depth).view(shape), weight.sum(1).view(shape), median.view(shape),
    )  # fmt: skip
    return Composite(raster, raw, light, depth)


@torch.no_grad()
def margin(found: Composite) -> Tensor:
    """(H, W) the relative distance of each pixel to its nearest cut (LEAST_ALPHA, LEAST_LIGHT, half of the light, equal
    depths), where rounding decides and the result jumps."""
    _, alpha, light, depth = found
    margins = [alpha.new_ones((len(alpha), 1)), (alpha / LEAST_ALPHA - 1).abs()]
    margins += [(light / cut - 1).abs() for cut in (LEAST_LIGHT, 0.5)]
    gap = depth.diff().abs() / depth[1:] if len(depth) > 1 else depth.new_ones(1)
    return torch.cat(margins, 1).amin(1).minimum(gap.amin()).view(found.raster.opacity.shape)
