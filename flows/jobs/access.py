"""Reading what several stages need from a store: cameras, roles, images."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import torch

from cat3d_core.cameras import Cameras
from cat3d_core.normalization import Similarity
from flows.errors import InputError
from schemas.layout import ROLES
from schemas.scene_store import Run, SceneStore, Section


def read_cameras(section: Section, views: Sequence[int] | None = None) -> Cameras:
    """Cameras of a section that has `intrinsics`, `world_from_camera` and `size`: scene frame, float64."""
    return Cameras(
        torch.from_numpy(section.read("intrinsics", views)),
        torch.from_numpy(section.read("world_from_camera", views)),
        torch.from_numpy(section.read("size", views).astype(np.int64)),
    )


def write_cameras(section: Section, cameras: Cameras) -> None:
    """Write the three camera arrays of a section."""
    section.write("intrinsics", cameras.intrinsics.double().numpy())
    section.write("world_from_camera", cameras.world_from_camera.double().numpy())
    section.write("size", cameras.size.numpy().astype(np.int32))


def read_similarity(store: SceneStore) -> Similarity:
    """The similarity from the data set's world to the scene frame."""
    document = store.captured.attrs["similarity"]
    return Similarity(
        document["scale"],
        torch.tensor(document["rotation"], dtype=torch.float64),
        torch.tensor(document["translation"], dtype=torch.float64),
        document["method"],
    )


def views_with_role(store: SceneStore, run: Run, role: str) -> list[int]:
    """Indices of the views with this role in the run ("train", "test") whose pose is known, in captured order.

    Raises InputError when no training view has a pose.
    """
    views = np.flatnonzero((run.read("role") == ROLES[role]) & store.captured.read("registered")).tolist()
    if role == "train" and not views:
        raise InputError(
            f"None of the training views of {store.scene_id} {run.name} could be placed; "
            "give their cameras, or train on other views."
        )
    return views


def read_images(section: Section, views: Sequence[int]) -> Iterator[torch.Tensor]:
    """Images of the views, each (h, w, 3) uint8 without padding, read when it is asked for: together they may be more
    than the memory holds."""
    return (torch.from_numpy(np.ascontiguousarray(section.read_image("image", v))) for v in views)


def read_masks(store: SceneStore, views: Sequence[int]) -> list[torch.Tensor | None] | None:
    """Masks (h, w) bool of the views, False where a pixel must not be trained on; None where the scene has no such
    masks (masks that only say what an object is, such as DTU's, are for the metrics)."""
    if not store.captured.attrs.get("mask_training") or "mask" not in store.captured:
        return None
    return [torch.from_numpy(store.captured.read_image("mask", v) >= 128) for v in views]
