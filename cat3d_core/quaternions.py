"""Rotations as quaternions w, x, y, z, and back."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import normalize


def rotation_matrices(quaternions: Tensor) -> Tensor:
    """(..., 4) quaternions w, x, y, z of any length but 0 -> (..., 3, 3) rotations."""
    return unit_rotations(quaternions / quaternions.norm(dim=-1, keepdim=True))


def unit_rotations(quaternions: Tensor) -> Tensor:
    """As `rotation_matrices`, of quaternions whose length is 1 already."""
    w, x, y, z = quaternions.unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


def quaternions_from_rotations(rotation: Tensor) -> Tensor:
    """(..., 3, 3) -> unit quaternions (..., 4) w, x, y, z with the largest part positive.

    Each column of 4 q q^T is a multiple of q; the longest one is taken, so that nothing cancels.
    """
    m = rotation
    xx, yy, zz = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    wx, wy, wz = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    xy, xz, yz = m[..., 0, 1] + m[..., 1, 0], m[..., 0, 2] + m[..., 2, 0], m[..., 1, 2] + m[..., 2, 1]
    outer = torch.stack(
        [
            1 + xx + yy + zz, wx, wy, wz,
            wx, 1 + xx - yy - zz, xy, xz,
            wy, xy, 1 - xx + yy - zz, yz,
            wz, xz, yz, 1 - xx - yy + zz,
        ],
        -1,
    ).unflatten(-1, (4, 4))  # fmt: skip
    longest = outer.diagonal(dim1=-2, dim2=-1).argmax(-1)
    row = outer.gather(-2, longest[..., None, None].expand(*longest.shape, 1, 4))[..., 0, :]
    return normalize(row, dim=-1)


def quaternion_product(a: Tensor, b: Tensor) -> Tensor:
    """(..., 4) of the rotation `b`, then `a`."""
    (aw, ax, ay, az), (bw, bx, by, bz) = a.unbind(-1), b.unbind(-1)
    parts = [
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    ]
    return torch.stack(parts, -1)
