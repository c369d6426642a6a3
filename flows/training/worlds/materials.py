"""What a mesh's texture name means: materials.xml of its folder, of the track, and of all."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flows.errors import InputError
from flows.training.worlds.scene import find_file, read_xml, texture_folders
from flows.training.worlds.textures import GREY, read_texture


class Kind(IntEnum):
    """How a surface stops rays."""

    SOLID = 0
    CUT_OUT = 1
    """Where the texture's opacity is above a half: leaves, fences, glass."""
    UNSEEN = 2
    """Glows and distortions of the air."""


_KINDS = {
    "alphatest": Kind.CUT_OUT, "alphablend": Kind.CUT_OUT, "grass": Kind.CUT_OUT,
    "additive": Kind.UNSEEN, "displace": Kind.UNSEEN,
}  # fmt: skip


@dataclass(frozen=True)
class MaterialTable:
    """For each of N materials: kind (N,); texture (N,) in the atlas; unlit (N,): shines by itself; blend (N,): the
    texture that weights four layers (N, 4), or -1."""

    kind: NDArray[np.int64]
    texture: NDArray[np.int64]
    unlit: NDArray[np.bool_]
    blend: NDArray[np.int64]
    layers: NDArray[np.int64]


class Materials:
    """Numbers materials as meshes name them. kinds: of each number; usable: whether a file may be read."""

    def __init__(self, data: Path, track: Path, usable: Callable[[Path], bool] = lambda path: True) -> None:
        self._data, self._track, self._usable = data, track, usable
        self._numbers: dict[tuple[str, str, Path], int] = {}
        self._entries: dict[Path, dict[str, list[ET.Element]]] = {}
        self._textures: dict[tuple[Path, Path | None, bool], int] = {}
        self._images: list[NDArray[np.uint8]] = [np.full((1, 1, 4), GREY, np.uint8)]
        self._clamped, self._rows = [True], list[tuple[int, bool, int, list[int]]]()
        self.kinds: list[Kind] = []

    def number(self, textures: tuple[str, str], folder: Path) -> int:
        """The material of a buffer with these texture names in a mesh of `folder`."""
        key = (*textures, folder)
        if key not in self._numbers:
            self._numbers[key] = self._new(*textures, folder)
        return self._numbers[key]

    def _new(self, first: str, second: str, folder: Path) -> int:
        entry = self._entry(first, second, folder)
        shader = entry.get("shader", "solid")
        texture = self._texture(first, folder, entry)
        blend, layers = -1, [0, 0, 0, 0]
        if shader == "splatting" and find_file(second, folder, self._track, *texture_folders(self._data)):
            blend = self._texture(second, folder, ET.Element("material"))
            layers = [
                self._texture(entry.get(f"tex-layer-{n}", ""), folder, ET.Element("material")) for n in range(2, 6)
            ]
        self._rows.append((texture, shader == "unlit", blend, layers))
        self.kinds.append(_KINDS.get(shader, Kind.SOLID) if texture else Kind.SOLID)
        return len(self.kinds) - 1

    def _entry(self, first: str, second: str, folder: Path) -> ET.Element:
        """The material's element; where several have the name, the one that names the second texture too."""
        for place in (folder, self._track, self._data / "textures"):
            found = self._listed(place).get(first, [])
            if found:
                return next((e for e in found if e.get("uv-two-tex") == second), found[0])
        return ET.Element("material")

    def _listed(self, folder: Path) -> dict[str, list[ET.Element]]:
        if folder not in self._entries:
            listed: dict[str, list[ET.Element]] = {}
            if (folder / "materials.xml").is_file():
                for element in read_xml(folder / "materials.xml").iter("material"):
                    listed.setdefault(element.get("name", ""), []).append(element)
            self._entries[folder] = listed
        return self._entries[folder]

    def _texture(self, name: str, folder: Path, entry: ET.Element) -> int:
        """Its number in the atlas; 0, a grey, where there is no such file, or it may not be used."""
        places = (folder, self._track, *texture_folders(self._data))
        path, mask = find_file(name, *places), find_file(entry.get("mask"), *places)
        if path is None or not self._usable(path):
            return 0
        clamped = entry.get("clampu") == "Y" or entry.get("clampv") == "Y"
        key = (path, mask, clamped)
        if key not in self._textures:
            self._textures[key] = len(self._images)
            self._images.append(read_texture(path, mask))
            self._clamped.append(clamped)
        return self._textures[key]

    def files(self) -> list[Path]:
        """Image files read so far."""
        return sorted({path for pair in self._textures for path in pair[:2] if path is not None})

    def images(self) -> tuple[list[NDArray[np.uint8]], list[bool]]:
        """What the atlas is made of, in order."""
        return self._images, self._clamped

    def table(self) -> MaterialTable:
        """All materials so far. Raises InputError where there is none."""
        if not self._rows:
            raise InputError(f"{self._track} has no materials.")
        texture, unlit, blend, layers = zip(*self._rows, strict=True)
        as_numbers: Sequence = [np.array(part, np.int64) for part in (self.kinds, texture, blend, layers)]
        return MaterialTable(as_numbers[0], as_numbers[1], np.array(unlit, bool), as_numbers[2], as_numbers[3])
