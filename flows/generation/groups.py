"""The groups of a stored plan: what each is conditioned on, what the network is given, and which views it makes."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cat3d_core.cameras import Cameras
from cat3d_core.random import normal
from cat3d_core.rays import raymap
from cat3d_core.sample_sets import KINDS, sample_cameras
from cat3d_core.view_selection import pose_distance
from flows.jobs.access import read_cameras
from schemas.content_key import content_key
from schemas.scene_store import Run, SceneStore

#: Names of the captured views' latents for each sample kind.
CAPTURED_LATENTS = dict(zip(KINDS, ("captured", "captured_wide"), strict=True))


@dataclass(frozen=True)
class Group:
    """Views sampled together: targets (n) planned views; conditions (m), below V a captured view, V + v planned view v.

    kind: the sample set, "square" or "wide".
    """

    targets: list[int]
    conditions: list[int]
    kind: str


class StoredPlan:
    """The plan of a run as the sampler needs it, read once."""

    def __init__(self, store: SceneStore, run: Run, seed: int) -> None:
        self.store, self.run, self.seed = store, run, seed
        section = run.plan
        self.image_size = int(section.attrs["image_size"])
        self.cameras = read_cameras(section)
        self.captured_count = store.captured.shape("size")[0]
        self.captured = {
            kind: sample_cameras(read_cameras(store.captured), kind, self.image_size) for kind in section.attrs["kinds"]
        }
        self.groups = _groups(
            section.read("group_views"),
            section.read("group_valid"),
            section.read("condition"),
            section.read("sample_kind"),
        )
        self.anchor: NDArray[np.bool_] = section.read("anchor")
        self.needed = bool(section.attrs["needed"])

    def __len__(self) -> int:
        return len(self.cameras)

    def passes(self) -> list[list[int]]:
        """Numbers of the groups that can be sampled at the same time: those of anchors, then the others; none where
        nothing need be generated."""
        if not self.needed:
            return []
        first = [g for g, group in enumerate(self.groups) if self.anchor[group.targets[0]]]
        return [p for p in (first, sorted(set(range(len(self.groups))) - set(first))) if p]

    def condition_latents(self, group: Group) -> Tensor:
        """(M, C, h, w) float32, as stored: encoded captured views and the latents of anchors, never decoded between."""
        rows = []
        for view in group.conditions:
            if view < self.captured_count:
                rows.append(self.store.latents.read(CAPTURED_LATENTS[group.kind], [view])[0])
            else:
                rows.append(self.run.generated.read("latent", [view - self.captured_count])[0])
        return torch.from_numpy(np.stack(rows)).float()

    def raymaps(self, group: Group, latent_size: int) -> Tensor:
        """(M + N, 6, h, w) float32: rays of the conditioning views, then of the targets, in the frame of the first."""
        cameras = [self._camera(view, group.kind) for view in group.conditions]
        together = Cameras.cat([*cameras, self.cameras[group.targets]])
        return raymap(together, together.world_from_camera[0], latent_size, latent_size).float()

    def noise(self, group: Group, shape: tuple[int, int, int]) -> Tensor:
        """(N, C, h, w): each view's own numbers, whatever group, batch or worker it is in."""
        return torch.stack([normal(shape, self.seed, self.store.scene_id, view, "noise") for view in group.targets])

    def distance(self, group: Group) -> float:
        """How far the targets are from the nearest captured view they are conditioned on, on average: pose distance in
        scene units (see `pose_distance`); infinite for groups conditioned on anchors alone."""
        captured = [view for view in group.conditions if view < self.captured_count]
        if not captured:
            return math.inf
        distances = pose_distance(self.cameras[group.targets], self.captured[group.kind][captured], scale=1.0)
        return float(distances.amin(1).mean())

    def _camera(self, view: int, kind: str) -> Cameras:
        if view < self.captured_count:
            return self.captured[kind][view]
        return self.cameras[view - self.captured_count]


def view_keys(step_key: str, views: int) -> list[str]:
    """The content key of each generated view: of everything its stage's key covers, and its number."""
    return [content_key(step=step_key, view=view) for view in range(views)]


def _groups(
    views: NDArray[np.int32], valid: NDArray[np.bool_], condition: NDArray[np.int32], kind: NDArray[np.uint8]
) -> list[Group]:
    groups = []
    for row, kept in zip(views, valid, strict=True):
        targets = row[kept].tolist()
        conditions = condition[targets[0]]
        groups.append(Group(targets, conditions[conditions >= 0].tolist(), KINDS[int(kind[targets[0]])]))
    return groups
