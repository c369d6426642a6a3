"""Groups of worlds on disk, in the same shards as procedural scenes (`flows/training/renders.py`)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from torch import Tensor

from flows.errors import InputError
from flows.training.renders import save
from flows.training.worlds.groups import Group, Studio, group
from flows.training.worlds.licences import Licences
from flows.training.worlds.light import Sky
from flows.training.worlds.package import copyright_file, data_folder
from flows.training.worlds.placing import KINDS
from flows.training.worlds.scene import read_track
from flows.training.worlds.world import World

SHARD_GROUPS = 10
# `family` of a shard: the procedural families come first.
FIRST_FAMILY = 5


def open_track(package: Path, name: str) -> Studio:
    """A track of the unpacked package, ready to be photographed, without files whose licence is not a free one.
    Raises InputError for missing or damaged files."""
    data, licences = data_folder(package), Licences(copyright_file(package))

    def usable(path: Path) -> bool:
        return licences.of(str(path.relative_to(data.parent))).free

    scene = read_track(data, name)
    if scene.sky is not None and not all(usable(path) for path in scene.sky):
        scene.sky = None
    return Studio(name, World(scene, data, usable), Sky.of(scene))


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
    advance: Callable[[int], None], first: int = 0,
) -> None:  # fmt: skip
    """Photograph the shards `mine` that are not in `folder`/renders yet, tracks in turn; shard n becomes file
    `first` + n. `advance` is called with the number of groups done.

    Where a track has no room for a single group, the next one takes its turn. Raises InputError where none has."""
    for shard in mine:
        path = folder / "renders" / f"{first + shard:05d}.safetensors"
        if not path.exists():
            parts = [as_tensors(one) for one in _any_groups(package, tracks, shard, views, size, seed)]
            save(path, {key: torch.stack([part[key] for part in parts]) for key in parts[0]})
        advance(SHARD_GROUPS)


def _any_groups(package: Path, tracks: Sequence[str], shard: int, views: int, size: int, seed: int) -> list[Group]:
    for step in range(len(tracks)):
        name = tracks[(shard + step) % len(tracks)]
        found = shard_groups(open_track(package, name), shard // len(tracks), views, size, seed)
        if found:
            return found
    raise InputError(f"{package}: none of the tracks has room for groups of {views} cameras; ask for fewer views.")


def shard_numbers(groups: int) -> range:
    """Shard n holds the groups from n * SHARD_GROUPS on."""
    return range(-(-groups // SHARD_GROUPS))
