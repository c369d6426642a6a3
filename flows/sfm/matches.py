"""Features of photos and their matches, for checks on cameras: SIFT at a small size, mutual nearest neighbours."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from flows.media.lens import distort
from flows.readers.base import Capture
from flows.sfm.colmap import pycolmap

# Photos are reduced by a whole factor to at least half and at most this many pixels on the long side.
LONG_SIDE = 800
FEATURES = 1024
# How far, as a ratio of descriptor distances, the best neighbour must be ahead of the second.
RATIO = 0.8
# Where undistortion of a point does not come closer than this to the point (in focal lengths), it is left out.
UNDISTORTED = 1e-3
STEPS = 30


@dataclass(frozen=True)
class Features:
    """Of one view: rays (F, 2) float64, x = X/Z and y = Y/Z of each feature in its camera; descriptors (F, 128)
    float32 of length 1, those of coarse features first; unit: the length, as a ray, of 1/800 of the long side."""

    rays: np.ndarray
    descriptors: Tensor
    unit: float


def features(capture: Capture, view: int, image: np.ndarray) -> Features:
    """The features of a view; image (H, W, 3) uint8 as its camera has it. Needs `capture.cameras`."""
    assert capture.cameras is not None
    factor = max(1, round(max(image.shape[:2]) / LONG_SIDE))
    height, width = (side // factor for side in image.shape[:2])
    grey = image[: height * factor, : width * factor].mean(-1, dtype=np.float32)
    small = grey.reshape(height, factor, width, factor).mean((1, 3))
    options = pycolmap.FeatureExtractionOptions(num_threads=1)
    options.sift.max_num_features = FEATURES
    options.sift.first_octave, options.sift.max_num_orientations = 0, 1  # the photo is not enlarged first
    options.sift.peak_threshold /= 2
    extractor = pycolmap.FeatureExtractor.create(options, pycolmap.Device.cpu)
    keypoints, found = extractor.extract_from_float32_array(np.ascontiguousarray(small / 255))
    points, described = _arrays(keypoints, found)
    k = capture.cameras.intrinsics[view]
    rays = (torch.from_numpy(points[:, :2]).double() * factor - k[:2, 2]) / k[[0, 1], [0, 1]]
    kept = torch.ones(len(rays), dtype=torch.bool)
    if capture.distortion is not None:
        fisheye = capture.fisheye is not None and bool(capture.fisheye[view])
        rays, kept = undistorted(rays, capture.distortion[view], fisheye)
    coarse_first = np.argsort(-points[:, 2], kind="stable")
    coarse_first = coarse_first[kept.numpy()[coarse_first]]
    unit = torch.from_numpy(described[coarse_first].astype(np.float32))
    length = max(image.shape[:2]) / LONG_SIDE / float(k[0, 0])
    return Features(rays.numpy()[coarse_first], torch.nn.functional.normalize(unit, dim=1), length)


def undistorted(rays: Tensor, distortion: Tensor, fisheye: bool = False) -> tuple[Tensor, Tensor]:
    """Where in a pinhole image the distorted positions (F, 2) are, and for which (F) bool that could be solved."""
    out = rays.clone()
    if fisheye:  # the first guess must not be far: the angle is about the distorted radius
        radius = rays.norm(dim=1, keepdim=True).clamp(1e-9, 1.4)
        out = rays / radius * radius.tan()
    for _ in range(STEPS):
        bent = distort(out, distortion, fisheye)
        if fisheye:
            out = out * (rays.norm(dim=1, keepdim=True) / bent.norm(dim=1, keepdim=True).clamp(min=1e-9))
        else:
            out = out + (rays - bent)
    solved = (distort(out, distortion, fisheye) - rays).norm(dim=1) < UNDISTORTED
    return torch.where(solved[:, None], out, rays), solved & out.isfinite().all(1)


def matches(a: Features, b: Features, first: int | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Indices (M) into the features of both, one to one; first: only so many coarse features of each."""
    da, db = a.descriptors[:first], b.descriptors[:first]
    if min(len(da), len(db)) < 2:
        return np.zeros(0, int), np.zeros(0, int)
    likeness = da @ db.T
    two, nearest = likeness.topk(2, dim=1)
    distance = (2 - 2 * two).clamp(min=0).sqrt()
    mutual = likeness.argmax(0)[nearest[:, 0]] == torch.arange(len(da))
    kept = mutual & (distance[:, 0] < RATIO * distance[:, 1])
    return kept.nonzero()[:, 0].numpy(), nearest[kept, 0].numpy()


def _arrays(keypoints: Any, descriptors: Any) -> tuple[np.ndarray, np.ndarray]:
    """(F, 3) x, y, scale in pixels, centres at integer + 0.5; (F, 128)."""
    points = np.array([[p.x, p.y, p.compute_scale()] for p in keypoints], np.float32).reshape(-1, 3)
    return points, np.asarray(getattr(descriptors, "data", descriptors)).reshape(len(points), 128)
