"""When SEVA's second pass is meant: where views made before are among the given ones."""

from __future__ import annotations

import dataclasses

import torch

from cat3d_core.generation import ViewGroup
from cat3d_core.seva.generator import _has_anchors
from tests.core.seva.models import ring


def test_views_that_no_captured_camera_stands_for_are_anchors() -> None:
    scene = ring(5)
    latents, noise = torch.zeros(2, 4, 8, 8), torch.zeros(1, 4, 8, 8)
    group = ViewGroup(latents, scene[[3, 1, 4]], noise, scene=scene)
    assert not _has_anchors(group)  # the third is a target
    poses = scene.world_from_camera[[3, 1, 4]].clone()
    poses[1, 0, 3] += 0.1
    moved = dataclasses.replace(group.cameras, world_from_camera=poses)
    assert _has_anchors(dataclasses.replace(group, cameras=moved))
    assert not _has_anchors(dataclasses.replace(group, scene=None))
