"""Groups of worlds on disk, in the same shards as procedural scenes (`flows/training/renders.py`)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from torch import Tensor

from flows.training.renders import save
from flows.training.worlds.groups import Group, Studio, group
from flows.training.worlds.light import Sky
from flows.training.worlds.package import data_folder
from flows.training.worlds.placing import KINDS
from flows.training.worlds.scene import read_track
from flows.training.worlds.world import World

SHARD_GROUPS = 10
# `family` of a shard: the procedural families come first.
FIRST_FAMILY = 5


def open_track(package: Path, name: str) -> Studio:
    """A track of the unpacked package, ready to be photographed. Raises InputError for missing or damaged files."""
    data = data_folder(package)
    scene = read_track(data, name)
    return Studio(name, World(scene, data), Sky.of(scene))


def as_tensors(found: Group) -> dict[str, Tensor]:
    """A group as it is stored."""
    return {
        "image": found.image,
        "intrinsics": found.cameras.intrinsics.float(),
        "world_from_camera": found.cameras.world_from_camera.float(),
        "inverse_depth": found.inverse_depth.half(),
        "family": torch.tensor(FIRST_FAMILY + KINDS.index(found.kind)),
    }


def shard_groups(studio: Studio, turn: int, views: int, size: int, seed: int) -> list[Group]:
    """The groups of a track's shard number `turn`: SHARD_GROUPS, or fewer where the track has too little room."""
    found: list[Group] = []
    first = 2 * turn * SHARD_GROUPS
    for number in range(first, first + 2 * SHARD_GROUPS):
        if len(found) == SHARD_GROUPS:
            break
        try:
            found.append(group(studio, number, views, size, seed))
        except ValueError:
            continue
    return found


def world_shards(
    folder: Path, package: Path, tracks: Sequence[str], mine: Sequence[int], views: int, size: int, seed: int,
    advance: Callable[[int], None],
) -> list[str]:  # fmt: skip
    """Photograph the shards `mine` that are not in `folder`/renders yet, tracks in turn. `advance` is told of groups
    done. Returns sentences about tracks with no room at all."""
    notes: list[str] = []
    for shard in mine:
        path = folder / "renders" / f"{shard:05d}.safetensors"
        name, turn = tracks[shard % len(tracks)], shard // len(tracks)
        if not path.exists():
            found = shard_groups(open_track(package, name), turn, views, size, seed)
            if found:
                parts = [as_tensors(one) for one in found]
                save(path, {key: torch.stack([part[key] for part in parts]) for key in parts[0]})
            else:
                notes.append(f"Track {name} has no room for groups of {views} cameras; it is left out.")
        advance(SHARD_GROUPS)
    return notes
