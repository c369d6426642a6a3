"""The groups of a stored plan as a generator is given them: latents, cameras and noise from the store."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from cat3d_core.cameras import Cameras
from cat3d_core.generation import Generator, ViewGroup
from cat3d_core.plan import Group
from cat3d_core.random import normal
from cat3d_core.sample_sets import KINDS, sample_cameras
from cat3d_core.view_selection import pose_distance
from flows.generation.hints import StoredHint, read_hint
from flows.generation.plan import read_plan
from flows.generation.views import captured_sample
from flows.jobs.access import read_cameras
from schemas.content_key import content_key
from schemas.scene_store import Run, SceneStore

#: Names of the captured views' latents for each sample kind.
CAPTURED_LATENTS = dict(zip(KINDS, ("captured", "captured_wide"), strict=True))


class StoredPlan:
    """The plan of a run as the sampler needs it, read once; `plan` counts the store's captured views."""

    def __init__(self, store: SceneStore, run: Run, seed: int, hinted: bool = True) -> None:
        """hinted: what the run has of hints is used."""
        self.store, self.run, self.seed, self.hinted = store, run, seed, hinted
        self.captured_count = store.captured.shape("size")[0]
        self.plan = read_plan(run.plan, self.captured_count)
        size = int(self.plan.cameras.size[0, 0])
        kinds = dict.fromkeys(group.kind for group in self.groups)
        self.captured = {kind: sample_cameras(read_cameras(store.captured), kind, size) for kind in kinds}

    def __len__(self) -> int:
        return len(self.plan)

    @property
    def groups(self) -> tuple[Group, ...]:
        return self.plan.groups

    @property
    def cameras(self) -> Cameras:
        return self.plan.cameras

    @property
    def needed(self) -> bool:
        return self.plan.needed

    def passes(self) -> list[list[int]]:
        """Numbers of the groups that can be sampled at the same time (see `Plan.passes`)."""
        return self.plan.passes()

    def view_group(self, group: Group, generator: Generator) -> ViewGroup:
        """What a generator is given to sample a group: latents as stored, of anchors never decoded between."""
        given = [self._camera(view, group.kind) for view in group.conditions]
        latents = self.condition_latents(group)
        return ViewGroup(
            latents=latents,
            cameras=Cameras.cat([*given, self.cameras[group.targets]]),
            noise=self.noise(group, generator.spec.latent_shape),
            images=self._images(group, latents, generator) if "images" in generator.spec.wants else None,
            scene=self.captured[group.kind],
            planned=self._planned(group.kind) if "planned" in generator.spec.wants else None,
            hints=self._hints(group) if "hints" in generator.spec.wants else {},
        )

    def _hints(self, group: Group) -> dict[str, Tensor]:
        """What the photos show of the targets, where the run has it."""
        if not self.hinted or "hints" not in self.run:
            return {}
        rows = [read_hint(self.run, view) for view in group.targets]
        maps = {name: torch.stack([getattr(row, name) for row in rows]) for name in StoredHint._fields}
        return maps | {"colour": maps["colour"].permute(0, 3, 1, 2) / 255}

    def _planned(self, kind: str) -> Cameras:
        """The cameras of all planned views of a sample set."""
        return self.cameras[(self.plan.sample_kind == KINDS.index(kind)).nonzero()[:, 0]]

    def _images(self, group: Group, latents: Tensor, generator: Generator) -> Tensor:
        """(M, 3, H, W) in [0, 1]: captured views as they were encoded, anchors decoded."""
        images = []
        for view, latent in zip(group.conditions, latents, strict=True):
            if view < self.captured_count:
                images.append(captured_sample(self.store, view, group.kind, generator.spec.image_size[0]))
            else:
                images.append(generator.decode(latent[None])[0])
        return torch.stack(images)

    def condition_latents(self, group: Group) -> Tensor:
        """(M, C, h, w) float32: encoded captured views and the latents of anchors."""
        rows = []
        for view in group.conditions:
            if view < self.captured_count:
                rows.append(self.store.latents.read(CAPTURED_LATENTS[group.kind], [view])[0])
            else:
                rows.append(self.run.generated.read("latent", [view - self.captured_count])[0])
        return torch.from_numpy(np.stack(rows)).float()

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
