"""Pixel rays, cones and raymaps."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from cat3d_core.cameras import Cameras


class Rays(NamedTuple):
    """origins (R, 3) and directions (R, 3) in the world; directions have z = 1 in their camera (not unit length), so
    that a point at parameter t lies at z-depth t. radii (R, 1): radius of the pixel's cone at t = 1."""

    origins: Tensor
    directions: Tensor
    radii: Tensor


class Pinholes(NamedTuple):
    """What the rays of N cameras follow from: K^-1, rotation (N, 3, 3), centers (N, 3), radii of cones (N, 1)."""

    inverse_k: Tensor
    rotation: Tensor
    centers: Tensor
    radii: Tensor

    @classmethod
    def of(cls, cameras: Cameras) -> Pinholes:
        """The cone radius follows mip-NeRF / Zip-NeRF: the mean of the distances to the rays one pixel to the right and
        one pixel down, times 2 / sqrt(12), so that the cone's variance is that of the pixel's footprint."""
        inverse_k = _inverse_intrinsics(cameras.intrinsics)
        # d(direction)/dx and /dy are the columns of R K^-1 (rotation keeps lengths, so K^-1 alone gives the norms).
        step = inverse_k[:, :, :2].norm(dim=1).mean(-1, keepdim=True)
        return cls(inverse_k, cameras.rotation, cameras.centers, step * 2 / 12**0.5)

    def rays(self, view: Tensor, xy: Tensor) -> Rays:
        """Rays through image points: view (R,) int64, which camera; xy (R, 2) in pixels (the centre of pixel (i, j) is
        i+0.5, j+0.5)."""
        homogeneous = torch.cat([xy, torch.ones_like(xy[:, :1])], -1)
        local = (self.inverse_k[view] * homogeneous[:, None]).sum(-1)
        directions = (self.rotation[view] * local[:, None]).sum(-1)
        return Rays(self.centers[view], directions, self.radii[view])


def pixel_rays(cameras: Cameras, view: Tensor, xy: Tensor) -> Rays:
    """`Pinholes.rays` of these cameras; who draws many times keeps the pinholes."""
    return Pinholes.of(cameras).rays(view, xy)


def image_rays(cameras: Cameras, view: int, width: int | None = None, height: int | None = None) -> Rays:
    """Rays through all pixel centres of one camera, row by row; optionally at another resolution."""
    camera = cameras[view]
    if width is not None and height is not None:
        camera = camera.resize(width, height)
    width, height = (int(s) for s in camera.size[0])
    y, x = torch.meshgrid(
        torch.arange(height, device=camera.intrinsics.device) + 0.5,
        torch.arange(width, device=camera.intrinsics.device) + 0.5,
        indexing="ij",
    )
    xy = torch.stack([x, y], -1).reshape(-1, 2).to(camera.intrinsics)
    return pixel_rays(camera, torch.zeros(len(xy), dtype=torch.long, device=xy.device), xy)


def reference_from_image(cameras: Cameras, reference: Tensor) -> Tensor:
    """(N, 4, 4) float64: each camera as one matrix, seen from the pose `reference` (4, 4).

    It takes (u d, v d, d, 1), with the z-depth d and u, v in [-1, 1] from edge to edge of the image, to the point
    (x, y, z, 1) in the frame of the reference. It says all that a pinhole camera is, whatever the image's size.
    """
    cams, pose = cameras.to(dtype=torch.float64), reference.double()
    image_from_square = torch.diag_embed(torch.nn.functional.pad(cams.size.double() / 2, (0, 1), value=1.0))
    image_from_square[:, :2, 2] = cams.size.double() / 2
    to_reference = pose[:3, :3].T
    out = torch.zeros_like(cams.world_from_camera)
    out[:, :3, :3] = to_reference @ cams.rotation @ _inverse_intrinsics(cams.intrinsics) @ image_from_square
    out[:, :3, 3] = (cams.centers - pose[:3, 3]) @ to_reference.T
    out[:, 3, 3] = 1
    return out


def matrix_rays(matrices: Tensor, height: int, width: int) -> Tensor:
    """(..., 6, height, width): origin and unit direction of the ray through the centre of each cell of views given as
    `reference_from_image` (..., 4, 4). A matrix of zeros gives rays of zeros."""
    y, x = ((torch.arange(n, dtype=matrices.dtype, device=matrices.device) * 2 + 1 - n) / n for n in (height, width))
    across, down, middle, origin = matrices[..., :3, :, None, None].unbind(-3)
    directions = across * x + down * y[:, None] + middle
    tiny = torch.finfo(matrices.dtype).tiny
    directions = directions / directions.norm(dim=-3, keepdim=True).clamp_min(tiny)
    return torch.cat([origin.expand_as(directions), directions], -3)


def raymap(cameras: Cameras, relative_to: Tensor, height: int, width: int, plucker: bool = False) -> Tensor:
    """(N, 6, height, width) ray of the centre of each latent cell, in the frame of the pose `relative_to` (4, 4).

    Channels 0-2: ray origin, or with `plucker` the moment origin x direction (Pluecker coordinates are (d, o x d);
    here the moment comes first so that both forms keep the direction in channels 3-5). Channels 3-5: unit direction.
    Distances are in the cameras' world unit, so hand in normalised cameras (one similarity per scene). Being relative
    to the first conditioning camera, the map does not change under rigid motions of the world (paper, 'Camera
    conditioning'). Computed in float64, returned in the cameras' dtype.
    """
    rays = matrix_rays(reference_from_image(cameras, relative_to), height, width)
    if plucker:
        rays = torch.cat([torch.linalg.cross(rays[:, :3], rays[:, 3:], dim=1), rays[:, 3:]], 1)
    return rays.to(cameras.intrinsics.dtype)


def _inverse_intrinsics(k: Tensor) -> Tensor:
    """Closed-form inverse of upper-triangular K (with skew): exact where a general inverse would round."""
    fx, skew, cx = k[:, 0, 0], k[:, 0, 1], k[:, 0, 2]
    fy, cy = k[:, 1, 1], k[:, 1, 2]
    inverse = torch.zeros_like(k)
    inverse[:, 0, 0], inverse[:, 1, 1], inverse[:, 2, 2] = 1 / fx, 1 / fy, 1
    inverse[:, 0, 1] = -skew / (fx * fy)
    inverse[:, 0, 2] = (skew * cy / fy - cx) / fx
    inverse[:, 1, 2] = -cy / fy
    return inverse


def perpendicular_basis(directions: Tensor) -> Tensor:
    """Two unit vectors (..., 2, 3) orthogonal to `directions` (..., 3) (any non-zero length) and to each other.

    Branch-free and deterministic, well conditioned for every direction (Duff et al., "Building an Orthonormal Basis,
    Revisited", JCGT 2017).
    """
    x, y, z = (directions / directions.norm(dim=-1, keepdim=True)).unbind(-1)
    sign = torch.where(z < 0, -1.0, 1.0).to(z.dtype)
    a = -1.0 / (sign + z)
    b = x * y * a
    first = torch.stack([1.0 + sign * x.square() * a, sign * b, -sign * x], -1)
    second = torch.stack([b, sign + y.square() * a, -y], -1)
    return torch.stack([first, second], -2)
