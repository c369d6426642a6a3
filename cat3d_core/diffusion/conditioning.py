"""What the network is told beside the noisy latents: which views are given, and from where each view looks."""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

import torch
from torch import Tensor

# Which part of the condition classifier-free guidance drops: the paper drops images and poses, SEVA only the images.
Drop = Literal["images_and_poses", "images"]


class Condition(NamedTuple):
    """latents [G, M, C, h, w] of the conditioning views; raymaps [G, M+N, 6, h, w]; mask [G, M+N], 1 = given."""

    latents: Tensor
    raymaps: Tensor
    mask: Tensor


def make_condition(latents: Tensor, raymaps: Tensor) -> Condition:
    """The first M of the raymaps' views are the conditioning views."""
    mask = torch.zeros(raymaps.shape[:2], device=raymaps.device)
    mask[:, : latents.shape[1]] = 1
    return Condition(latents, raymaps, mask)


def drop_condition(condition: Condition, dropped: Tensor, what: Drop) -> Condition:
    """The null condition for the groups where `dropped` [G] (bool): conditioning latents and mask become zero, and so
    do all rays unless only images are dropped."""
    keep = (~dropped).to(condition.raymaps.dtype)
    wide = keep[:, None, None, None, None]
    raymaps = condition.raymaps * wide if what == "images_and_poses" else condition.raymaps
    return Condition(condition.latents * wide.to(condition.latents.dtype), raymaps, condition.mask * keep[:, None])


def relative_raymaps(raymaps_world: Tensor, world_from_reference: Tensor) -> Tensor:
    """Express rays in another frame: [G, V, 6, h, w] (origin, direction) in the world -> in the frame of the poses
    [G, 4, 4], one per group (the first conditioning camera; paper, 'Camera conditioning')."""
    reference = world_from_reference.to(raymaps_world)
    rotation = reference[:, :3, :3]
    origins = raymaps_world[:, :, :3] - reference[:, None, :3, 3, None, None]
    return torch.cat(
        [torch.einsum("gij,gvihw->gvjhw", rotation, part) for part in (origins, raymaps_world[:, :, 3:])], 2
    )


def ray_features(raymaps: Tensor, octaves: int) -> Tensor:
    """[..., 6, h, w] -> [..., 6 (1 + 2 octaves), h, w]: the rays and sin, cos of 2^k pi / 2 times them, k < octaves
    (Fourier features as in SRT's raymaps, Sajjadi et al. 2022, and 3DiM's). A dropped (zero) map keeps a pattern of
    its own."""
    parts = [raymaps]
    for octave in range(octaves):
        angle = raymaps * (2**octave * math.pi / 2)
        parts += [angle.sin(), angle.cos()]
    return torch.cat(parts, -3)


def camera_vectors(raymaps: Tensor) -> Tensor:
    """The 8 numbers of the paper's pose-vector ablation (appendix C), read off the raymaps.

    raymaps [..., 6, h, w] (origin, direction; h, w >= 2) -> [..., 8]: position (3), unit quaternion w, x, y, z (4) and
    the focal length over the image width (1). A map of zeros (dropped pose) gives zeros.
    """
    width = raymaps.shape[-1]
    given, corner, across, down = _image_plane(raymaps)
    x_axis = torch.nn.functional.normalize(across, dim=-1)
    y_axis = torch.nn.functional.normalize(down - (down * x_axis).sum(-1, keepdim=True) * x_axis, dim=-1)
    z_axis = torch.linalg.cross(x_axis, y_axis)
    depth = (z_axis * corner).sum(-1, keepdim=True)
    focal = depth / (across.norm(dim=-1, keepdim=True) * width / (width - 1)).clamp_min(1e-12)
    quaternion = _quaternion(torch.stack([x_axis, y_axis, z_axis], -1))
    vector = torch.cat([raymaps[..., :3, 0, 0], quaternion, focal], -1)
    return torch.where(given[..., None], vector, torch.zeros_like(vector))


def view_matrices(raymaps: Tensor) -> tuple[Tensor, Tensor]:
    """Projection of each view and its inverse, read off the raymaps: image_from_reference, reference_from_image.

    raymaps [..., 6, h, w] (origin, direction; h, w >= 2) -> [..., 4, 4] twice. image_from_reference takes a point
    (x, y, z, 1) of the raymaps' frame to (u d, v d, d, 1): z-depth d, and u, v in [-1, 1] from edge to edge of the
    image. A map of zeros (dropped pose) gives identities.
    """
    height, width = raymaps.shape[-2:]
    given, corner, across, down = _image_plane(raymaps)
    along_u, along_v = across * (width / (width - 1) / 2), down * (height / (height - 1) / 2)
    center = corner + along_u * (1 - 1 / width) + along_v * (1 - 1 / height)
    forward = torch.nn.functional.normalize(torch.linalg.cross(along_u, along_v), dim=-1)
    rays_from_image = torch.stack([along_u, along_v, center], -1) / (forward * corner).sum(-1)[..., None, None]
    rays_from_image = torch.where(given[..., None, None], rays_from_image, torch.eye(3).to(rays_from_image))
    image_from_rays = torch.linalg.inv(rays_from_image)
    origin = raymaps[..., :3, 0, 0, None]
    last = torch.tensor([0.0, 0, 0, 1]).to(origin).expand(*origin.shape[:-2], 1, 4)
    there = torch.cat([torch.cat([image_from_rays, -image_from_rays @ origin], -1), last], -2)
    back = torch.cat([torch.cat([rays_from_image, origin], -1), last], -2)
    return there, back


def _image_plane(raymaps: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Whether a pose is given [...], and the plane that the directions of [..., 6, h, w] point to, up to its distance:
    the top left corner's unit direction and the edges from there to the right and down, [..., 3] each.

    A pinhole camera's directions are p = R K^-1 (u, v, 1) up to length, and p is affine in (u, v): the corners obey
    p00 - p10 - p01 + p11 = 0, three equations for the unknown lengths.
    """
    given = raymaps.abs().amax((-3, -2, -1)) > 0
    d00, d10 = raymaps[..., 3:, 0, 0], raymaps[..., 3:, 0, -1]
    d01, d11 = raymaps[..., 3:, -1, 0], raymaps[..., 3:, -1, -1]
    equations = torch.stack([d10, d01, -d11], -1)
    equations = torch.where(given[..., None, None], equations, torch.eye(3).to(equations))
    lengths = torch.linalg.solve(equations, d00[..., None])[..., 0]
    return given, d00, lengths[..., :1] * d10 - d00, lengths[..., 1:2] * d01 - d00


def _quaternion(rotation: Tensor) -> Tensor:
    """[..., 3, 3] -> [..., 4] (w, x, y, z), w >= 0: the largest eigenvector of the quaternion's outer product, taken
    from its best conditioned column (Shepperd's method without branches)."""
    r = rotation
    trace = r.diagonal(dim1=-2, dim2=-1).sum(-1)
    rows = [
        torch.stack(
            [1 + trace, r[..., 2, 1] - r[..., 1, 2], r[..., 0, 2] - r[..., 2, 0], r[..., 1, 0] - r[..., 0, 1]], -1
        )
    ]
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        row = [torch.zeros_like(trace)] * 4
        row[0] = r[..., k, j] - r[..., j, k]
        row[1 + i] = 1 + 2 * r[..., i, i] - trace
        row[1 + j] = r[..., j, i] + r[..., i, j]
        row[1 + k] = r[..., k, i] + r[..., i, k]
        rows.append(torch.stack(row, -1))
    outer = torch.stack(rows, -2)
    best = outer.diagonal(dim1=-2, dim2=-1).argmax(-1)
    q = outer.gather(-2, best[..., None, None].expand(*best.shape, 1, 4))[..., 0, :]
    q = torch.nn.functional.normalize(q, dim=-1)
    return torch.where(q[..., :1] < 0, -q, q)
