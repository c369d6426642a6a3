"""Similarity alignment of estimated cameras to true ones, and the pose errors after it."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from cat3d_core.cameras import Cameras
from cat3d_core.normalization import Similarity

# Singular values below this share of the largest count as zero: the points are collinear or coincident.
_RANK_TOLERANCE = 1e-9


def umeyama(source: Tensor, target: Tensor) -> Similarity:
    """The similarity that maps source (P, 3) onto target (P, 3) with the least squared error.

    Umeyama, Least-Squares Estimation of Transformation Parameters Between Two Point Patterns, PAMI 1991, eq. 40-42;
    computed in float64. Always a proper rotation (determinant +1), also for mirrored or planar points.
    Raises ValueError for fewer than three points, non-finite ones, or collinear or coincident ones: they leave the
    rotation undetermined (use `align_cameras`, whose orientations determine it).
    """
    source, target = _checked(source, target)
    if len(source) < 3:
        raise ValueError(f"A similarity needs at least three points, and there are {len(source)}.")
    source_mean, target_mean = source.mean(0), target.mean(0)
    covariance = (target - target_mean).T @ (source - source_mean) / len(source)
    u, d, vh = torch.linalg.svd(covariance)
    # Rank 2 (a plane) is enough: the third axis follows from the other two.
    if d[1] <= _RANK_TOLERANCE * d[0] or d[0] == 0:
        raise ValueError(
            "The points are collinear or coincident; they leave the rotation of the alignment undetermined."
        )
    signs = torch.ones(3, dtype=torch.float64)
    signs[2] = torch.linalg.det(u) * torch.linalg.det(vh)
    signs[2] = signs[2].sign()
    rotation = (u * signs) @ vh
    scale = float((d * signs).sum() / (source - source_mean).square().sum(-1).mean())
    return Similarity(scale, rotation, target_mean - scale * rotation @ source_mean, "umeyama")


def align_cameras(estimated: Cameras, truth: Cameras) -> Similarity:
    """The similarity that maps estimated cameras onto the true ones, from their centres and orientations.

    By `umeyama` over the centres and, for each camera, the points one spread of the centres (rms distance from their
    mean, each side in its own unit) along its axes. The orientations so determine the rotation where the centres are
    collinear, two, or one. For coincident centres the scale is 1.
    Raises ValueError for no cameras or different numbers of them.
    """
    if len(estimated) == 0:
        raise ValueError("There are no cameras to align.")
    a, b = _checked(estimated.centers, truth.centers)
    spreads = [_spread(a), _spread(b)]
    if min(spreads) <= 1e-12 * (1 + max(float(a.abs().max()), float(b.abs().max()))):
        spreads = [1.0, 1.0]
    points = []
    for cameras, centers, reach in zip((estimated, truth), (a, b), spreads, strict=True):
        tips = centers[:, None] + reach * cameras.rotation.double().transpose(1, 2)
        points.append(torch.cat([centers, tips.reshape(-1, 3)]))
    return umeyama(*points)


@dataclass(frozen=True)
class PoseErrors:
    """rotation_deg (N,) in degrees; center_share (N,): distance as a share of the true cameras' extent, which is the
    largest distance of a true centre from their mean."""

    rotation_deg: Tensor
    center_share: Tensor


def pose_errors(estimated: Cameras, truth: Cameras) -> PoseErrors:
    """Errors of N estimated poses after `align_cameras`."""
    aligned = align_cameras(estimated, truth).cameras(estimated.to(dtype=torch.float64))
    centers = truth.centers.double()
    extent = (centers - centers.mean(0)).norm(dim=-1).max()
    return PoseErrors(
        rotation_angle_deg(aligned.rotation, truth.rotation.double()),
        (aligned.centers - centers).norm(dim=-1) / extent.clamp(min=torch.finfo(torch.float64).tiny),
    )


def rotation_angle_deg(a: Tensor, b: Tensor) -> Tensor:
    """Angle (N,) in degrees of the rotation from a to b, (N, 3, 3) each.

    2 asin(|a - b| / (2 sqrt 2)), Frobenius norm: exact for small angles, where arccos of the trace loses digits.
    """
    chord = torch.linalg.matrix_norm(a - b) / 8**0.5
    return 2 * torch.rad2deg(torch.asin(chord.clamp(max=1)))


def _spread(points: Tensor) -> float:
    return float((points - points.mean(0)).square().sum(-1).mean().sqrt())


def _checked(source: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    if source.shape != target.shape or source.ndim != 2 or source.shape[1] != 3:
        raise ValueError(f"Alignment takes two (P, 3) sets; got {tuple(source.shape)} and {tuple(target.shape)}.")
    if not (torch.isfinite(source).all() and torch.isfinite(target).all()):
        raise ValueError("A point or camera centre is NaN or infinite; the alignment is undefined.")
    return source.double(), target.double()
