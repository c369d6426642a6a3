"""Which views are sampled together and what they see: anchors, groups, conditioning views (paper, 'Generating a large
set of synthetic views' and 'Anchor selection')."""

from __future__ import annotations

import torch
from torch import Tensor

from cat3d_core.cameras import Cameras

NO_VIEW = -1


def pose_distance(a: Cameras, b: Cameras, scale: float, direction_weight: float = 1.0) -> Tensor:
    """(len(a), len(b)) distances sqrt(|dc|^2 / scale^2 + w^2 |df|^2), c centres and f unit viewing directions.

    scale: the scene's distance, so that the result does not depend on the world's unit. Positions alone (w = 0) rank
    views of one object; the directions tell views apart that stand at one spot.
    """
    shift = torch.cdist(a.centers, b.centers, compute_mode="donot_use_mm_for_euclid_dist") / scale
    if direction_weight == 0:
        return shift
    turn = torch.cdist(a.forward, b.forward, compute_mode="donot_use_mm_for_euclid_dist")
    return torch.hypot(shift, direction_weight * turn)


def camera_distance(cameras: Cameras) -> Tensor:
    """(N, N) distance between centres plus angle between viewing directions (radians): what the nearest view is that
    samples are compared with."""
    cosine = (cameras.forward @ cameras.forward.T).clamp(-1, 1)
    return torch.cdist(cameras.centers, cameras.centers) + torch.acos(cosine)


def farthest_points(
    cameras: Cameras, count: int, scale: float = 1.0, given: Cameras | None = None, direction_weight: float = 0.0
) -> list[int]:
    """Indices of `count` cameras, each the farthest from those already taken (greedy k-means++ initialisation,
    Arthur and Vassilvitskii 2007; Gonzalez 1985 shows it within twice the best possible covering radius).

    given: cameras taken beforehand (the captured views); without any, the first camera starts. By default only
    positions count, as in the paper; when all that is left coincides with something taken, the lowest free index is.
    O(count * N) time, O(N) memory. Raises ValueError when count exceeds the cameras.
    """
    if not 0 <= count <= len(cameras):
        raise ValueError(f"{count} anchors were asked for, but the trajectory has {len(cameras)} views; ask for fewer.")
    nearest = torch.full((len(cameras),), torch.inf, dtype=cameras.centers.dtype, device=cameras.centers.device)
    if given is not None and len(given):
        nearest = pose_distance(cameras, given, scale, direction_weight).amin(1)
    taken: list[int] = []
    for _ in range(count):
        # argmax takes the lowest index among equals; rounding to 1e-9 keeps that true after the world is moved.
        best = int((nearest * 1e9).round().argmax())
        taken.append(best)
        reach = pose_distance(cameras, cameras[best], scale, direction_weight)[:, 0]
        nearest = torch.minimum(nearest, reach)
        nearest[best] = -1.0
    return taken


def covering_radius(cameras: Cameras, chosen: list[int], scale: float = 1.0) -> float:
    """Largest distance from any camera position to the nearest chosen one, in units of `scale`."""
    return float(pose_distance(cameras, cameras[chosen], scale, 0.0).amin(1).max())


def evenly(count: int, most: int) -> list[int]:
    """Positions of at most `most` of `count` things, in order, evenly spread from the first to the last."""
    return [round(i * (count - 1) / max(1, min(most, count) - 1)) for i in range(min(most, count))]


def consecutive_groups(views: list[int], size: int) -> list[list[int]]:
    """Runs of `size` of the given views in order; the last run may be shorter.

    Trajectory order keeps neighbours together (paper: groups are 'selected by their indices in the trajectories').
    """
    if size < 1:
        raise ValueError(f"A group needs at least one view; the group size is {size}.")
    return [views[i : i + size] for i in range(0, len(views), size)]


def nearest_views(
    group: Cameras, candidates: Cameras, count: int, scale: float, first: int = 0, repeat: bool = True
) -> list[int]:
    """Indices of the `count` candidates nearest to a group (mean pose distance over its views), nearest first.

    first: the first so many candidates (captured views) are taken before the others are considered, whatever their
    distance. Fewer candidates than count: the list is filled by repeating from the nearest on, which keeps the
    trained number of conditioning views, or with NO_VIEW when repeat is False. Raises ValueError for no candidates.
    """
    if len(candidates) == 0:
        raise ValueError("A group has no view to be conditioned on; give at least one captured view.")
    distance = pose_distance(group, candidates, scale).mean(0)
    order = sorted(range(len(candidates)), key=lambda i: (i >= first, round(float(distance[i]), 9), i))
    chosen = order[:count]
    fill = chosen if repeat else [NO_VIEW]
    return chosen + [fill[i % len(fill)] for i in range(count - len(chosen))]
