"""Photos as the plane sweep looks at them, and the depth that it finds for each of their pixels."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from cat3d_core.cameras import Cameras
from cat3d_core.matching import warp
from cat3d_core.matching.hint import observe, photo_depth
from cat3d_core.matching.network import partners
from cat3d_core.sample_sets import sample_cameras, source_boxes
from flows.generation.hints import open_sweep
from flows.generation.views import captured_sample
from flows.jobs.access import read_cameras
from flows.jobs.device import cpu_threads
from flows.jobs.job import Job
from schemas.scene_store import SceneStore

#: Side of the samples that depths are found in: the largest that the network was trained with.
SIDE = 128
#: Expected error of an inverse depth, in 1 / scene unit, at which the trust in it has fallen to a third.
SPREAD = 0.15
#: Other photos that may confirm a photo's depth, the nearest.
WITNESSES = 8


def photos(store: SceneStore, views: Sequence[int], kind: str, side: int) -> tuple[torch.Tensor, Cameras]:
    """The square samples (M, 3, side, side) of captured views, in [0, 1], and their cameras."""
    cameras = sample_cameras(read_cameras(store.captured, views), kind, side)
    return torch.stack([captured_sample(store, view, kind, side) for view in views]), cameras


def photo_depths(job: Job, store: SceneStore, views: Sequence[int]) -> list[tuple[torch.Tensor, torch.Tensor]]:
    """Of each of these captured views, the z-depth of its pixels (H, W) in scene units, infinite far away, and the
    trust in it (H, W) in [0, 1]: exp(-expected error of the inverse depth / SPREAD), and 0 where none of the nearest
    other views shows the place at that depth."""
    size = read_cameras(store.captured, views).size
    kind = "square" if bool((size[:, 0] == size[:, 1]).all()) else "wide"  # which shows whole photos
    network = open_sweep(job)
    image, cameras = photos(store, views, kind, SIDE)
    with cpu_threads(job.config.execution.threads):
        inverse, error = (part.cpu() for part in photo_depth(network, observe(network, image, cameras)))
    seen = warp.views(cameras)
    confirmed = warp.agreeing(inverse, seen, inverse, seen, partners(seen.pose, WITNESSES)).any(1)
    trust = torch.exp(-error / SPREAD) * confirmed
    found = []
    boxes = source_boxes(size, kind).tolist()
    for index, ((width, height), (x0, y0, side)) in enumerate(zip(size.tolist(), boxes, strict=True)):
        # The nearest pixel: a mean of depths before and behind an edge is the depth of nothing.
        scale = inverse.shape[-1] / side
        rows = ((torch.arange(height) + 0.5 - y0) * scale).long()[:, None]
        columns = ((torch.arange(width) + 0.5 - x0) * scale).long()
        near = inverse[index][rows, columns]
        depth = torch.where(near > 0, 1 / near.clamp_min(1e-6), torch.inf)
        found.append((depth, trust[index][rows, columns]))
    return found
