"""Distance between surfaces given as point sets."""

from __future__ import annotations

import torch
from torch import Tensor


def nearest_distances(points: Tensor, reference: Tensor, chunk: int = 1 << 24) -> Tensor:
    """Distance from each point to the nearest reference point: (P,), exact, brute force.

    points (P, 3), reference (Q, 3), one frame and unit. At most `chunk` pairs are held at a time. Differences are taken
    before squaring, so that points far from the origin lose nothing.
    """
    rows = max(1, chunk // max(1, reference.shape[0]))
    exact = "donot_use_mm_for_euclid_dist"
    return torch.cat([torch.cdist(part, reference, compute_mode=exact).amin(dim=1) for part in points.split(rows)])


def chamfer_distance(points: Tensor, reference: Tensor, threshold: float | None = None) -> dict[str, float]:
    """How far a reconstruction lies from a reference surface, both as points in one frame and unit.

    points (P, 3), reference (Q, 3). "accuracy": mean distance from the points to the reference; "completeness": the
    other way; "chamfer": their mean (the DTU convention). With a threshold (same unit) also "precision", "recall" and
    "fscore" (Tanks and Temples). Raises ValueError for an empty or non-finite set or another shape.
    """
    for name, cloud in (("points", points), ("reference", reference)):
        if cloud.ndim != 2 or cloud.shape[1] != 3 or cloud.shape[0] == 0:
            raise ValueError(f"The {name} have shape {tuple(cloud.shape)}; expected (P, 3) with at least one point.")
        if not bool(cloud.isfinite().all()):
            raise ValueError(f"The {name} hold NaN or infinite coordinates.")
    there, back = nearest_distances(points, reference).double(), nearest_distances(reference, points).double()
    accuracy, completeness = float(there.mean()), float(back.mean())
    result = {"accuracy": accuracy, "completeness": completeness, "chamfer": (accuracy + completeness) / 2}
    if threshold is not None:
        precision, recall = float((there < threshold).double().mean()), float((back < threshold).double().mean())
        total = precision + recall
        result |= {"precision": precision, "recall": recall, "fscore": 2 * precision * recall / total if total else 0.0}
    return result
