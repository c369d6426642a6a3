"""Held-out worlds: six tracks that no training sees, photographed once, as an evaluation of their own."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import torch
from safetensors.torch import load_file
from torch import Tensor

from cat3d_core.cameras import Cameras
from cat3d_core.random import generator
from flows.errors import InputError
from flows.training.renders import shards
from flows.training.worlds.package import HELD_OUT
from flows.training.worlds.placing import KINDS
from flows.training.worlds.shards import FIRST_FAMILY, shard_numbers, world_shards

SEED = 1


class HeldOutWorld(NamedTuple):
    """name: kind of camera path and number; image (V, 3, H, W) in [0, 1]; depth (V, H, W): z-depth in the unit of the
    normalised cameras, inf for the sky; cameras float64, in random order, so that the first ones can be given."""

    name: str
    image: Tensor
    depth: Tensor
    cameras: Cameras


def make_held_out_worlds(
    folder: Path, package: Path, groups: int, views: int, size: int, advance: Callable[[int], None]
) -> None:
    """Photograph at least `groups` groups of the held-out tracks into `folder`; what is there is not made again."""
    world_shards(folder, package, HELD_OUT, shard_numbers(groups), views, size, SEED, advance)


def held_out_worlds(folder: Path, views: int = 8) -> Iterator[HeldOutWorld]:
    """Groups of `views` cameras of the shards in `folder`. Raises InputError where there are none, or fewer views."""
    paths, count = shards(folder, "renders"), 0
    if not paths:
        raise InputError(f"{folder} holds no renders; make them with 'cat3d worlds PACKAGE --held-out {folder}'.")
    for path in paths:
        shard = load_file(path)
        for row in range(len(shard["image"])):
            total, side = shard["image"].shape[1], shard["image"].shape[-1]
            if total < views:
                raise InputError(f"{path} has groups of {total} views, fewer than the {views} asked for.")
            chosen = torch.randperm(total, generator=generator(SEED, "held-out world", count))[:views]
            cameras = Cameras(
                shard["intrinsics"][row, chosen].double(), shard["world_from_camera"][row, chosen].double(),
                torch.full((views, 2), side),
            )  # fmt: skip
            kind = KINDS[int(shard["family"][row]) - FIRST_FAMILY]
            image = shard["image"][row, chosen].float() / 255
            yield HeldOutWorld(f"{kind}_{count}", image, 1 / shard["inverse_depth"][row, chosen].float(), cameras)
            count += 1
