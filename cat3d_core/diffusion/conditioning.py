"""What the network is given beside the noisy latents: which views are given, and from where each view looks."""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

import torch
from torch import Tensor

# Which part of the condition classifier-free guidance drops: the paper drops images and poses, SEVA only the images.
Drop = Literal["images_and_poses", "images"]


class Condition(NamedTuple):
    """latents [G, M, C, h, w] of the conditioning views; cameras [G, M+N, 4, 4], `rays.reference_from_image` of each
    view with the first conditioning camera as the reference; mask [G, M+N], 1 = given; hints [G, M+N, C + 4, h, w] of
    what is known of the targets (hints.py), zero for given views, or None."""

    latents: Tensor
    cameras: Tensor
    mask: Tensor
    hints: Tensor | None = None


def make_condition(latents: Tensor, cameras: Tensor, hints: Tensor | None = None) -> Condition:
    """The first M of the cameras are the conditioning views'; hints [G, N, C + 4, h, w] of the others."""
    given = latents.shape[1]
    mask = torch.zeros(cameras.shape[:2], device=cameras.device)
    mask[:, :given] = 1
    if hints is not None:
        hints = torch.cat([hints.new_zeros(len(hints), given, *hints.shape[2:]), hints], 1)
    return Condition(latents, cameras, mask, hints)


def drop_condition(condition: Condition, dropped: Tensor, what: Drop) -> Condition:
    """The null condition for the groups where `dropped` [G] (bool): conditioning latents, hints and mask become zero,
    and so do all cameras, and with them the rays, unless only images are dropped."""
    keep = ~dropped
    maps = keep[:, None, None, None, None]
    cameras = condition.cameras * keep[:, None, None, None] if what == "images_and_poses" else condition.cameras
    hints = None if condition.hints is None else condition.hints * maps
    return Condition(condition.latents * maps, cameras, condition.mask * keep[:, None], hints)


def ray_features(raymaps: Tensor, octaves: int) -> Tensor:
    """[..., 6, h, w] -> [..., 6 (1 + 2 octaves), h, w]: the rays and sin, cos of 2^k pi / 2 times them, k < octaves
    (Fourier features as in SRT's raymaps, Sajjadi et al. 2022, and 3DiM's). A dropped (zero) map keeps a pattern of
    its own."""
    parts = [raymaps]
    for octave in range(octaves):
        angle = raymaps * (2**octave * math.pi / 2)
        parts += [angle.sin(), angle.cos()]
    return torch.cat(parts, -3)


def camera_vectors(cameras: Tensor) -> Tensor:
    """The 8 numbers of the paper's pose-vector ablation (appendix C): `reference_from_image` [..., 4, 4] -> [..., 8].

    Position (3), unit quaternion w, x, y, z (4) and the focal length over the image width (1). A matrix of zeros
    (dropped pose) gives zeros.
    """
    across, down = cameras[..., :3, 0], cameras[..., :3, 1]
    half = across.norm(dim=-1, keepdim=True)  # half an image at unit depth: width / (2 focal)
    x_axis = torch.nn.functional.normalize(across, dim=-1)
    y_axis = torch.nn.functional.normalize(down - (down * x_axis).sum(-1, keepdim=True) * x_axis, dim=-1)
    rotation = torch.stack([x_axis, y_axis, torch.linalg.cross(x_axis, y_axis)], -1)
    vector = torch.cat([cameras[..., :3, 3], _quaternion(rotation), 0.5 / half], -1)
    return torch.where(half > 0, vector, torch.zeros_like(vector))


def view_matrices(cameras: Tensor) -> tuple[Tensor, Tensor]:
    """image_from_reference and reference_from_image, [..., 4, 4] each, of views given as the latter. Matrices of zeros
    (dropped poses) give identities."""
    given = cameras.abs().amax((-2, -1), keepdim=True) > 0
    back = torch.where(given, cameras, torch.eye(4).to(cameras))
    return torch.linalg.inv(back), back


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
