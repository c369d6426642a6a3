"""The scene of a track: which meshes stand where, where one can walk, its sky. Frame from here on: +z up,
right-handed, metres."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flows.errors import InputError

MAX_XML_BYTES = 64 * 2**20
MAX_PLACEMENTS = 50_000
# Of a scene's alternatives, those that are there in a plain race.
_CONDITIONS = {None, "isTrackNotReverse", "isNotReverse", "isNotCTF", "isNotNetworking", "hasNoFlooding"}
_NOT_SEEN = {"physics-only", "physicsonly"}
# File axes are left-handed with y up; exchanging y and z makes them right-handed with z up, and mirrors nothing.
WORLD_FROM_FILE = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])


@dataclass(frozen=True)
class Placement:
    """A mesh and its pose: matrix (4, 4) float64 from the mesh's file frame to the world. thing: the number that all
    meshes of one object share (a house of the library may have several), or -1 for the track itself."""

    model: Path
    matrix: NDArray[np.float64]
    thing: int


@dataclass
class TrackScene:
    """placements; ground (P, 3): places to stand, in order along the drive line; sky: six image files (top, bottom,
    east, west, south, north), or None; sky_color (3,) in [0, 1]. missing: names in the files that are not there."""

    folder: Path
    placements: list[Placement] = field(default_factory=list)
    ground: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 3)))
    sky: list[Path] | None = None
    sky_color: tuple[float, float, float] = (0.45, 0.6, 0.8)
    missing: list[str] = field(default_factory=list)


def read_xml(path: Path) -> ET.Element:
    """The root of a small XML file without entities. Raises InputError for anything else."""
    try:
        if path.stat().st_size > MAX_XML_BYTES:
            raise InputError(f"{path} is larger than {MAX_XML_BYTES >> 20} MiB; is the file damaged?")
        text = path.read_bytes()
        if b"<!DOCTYPE" in text or b"<!ENTITY" in text:
            raise InputError(f"{path} declares a document type, which scene files never do; it is not read.")
        return ET.fromstring(text)  # nosec B314 # without entities, see above
    except FileNotFoundError:
        raise InputError(f"{path} is not there; fetch the package again.") from None
    except ET.ParseError as error:
        raise InputError(f"{path} is no well-formed XML ({error}); fetch the package again.") from None


def find_file(name: str | None, *folders: Path) -> Path | None:
    """The file of that name in the first folder that has it. A name with a path in it is nobody's."""
    if not name or "/" in name or "\\" in name or name in (".", ".."):
        return None
    return next((folder / name for folder in folders if (folder / name).is_file()), None)


def texture_folders(data: Path) -> tuple[Path, ...]:
    """Where textures lie that no track has to itself."""
    return tuple(data / "textures" / name for name in ("", "skybox", "deprecated"))


def read_track(data: Path, name: str) -> TrackScene:
    """The scene of track `name` under the game's data folder. Raises InputError where its files are missing or
    damaged."""
    folder = data / "tracks" / name
    scene, root = TrackScene(folder), read_xml(folder / "scene.xml")
    _Placer(data, scene).place(root, folder, WORLD_FROM_FILE, thing=None)
    scene.ground = _ground(folder)
    _read_sky(root, data, scene)
    return scene


class _Placer:
    """Walks through scene.xml and the library's node.xml files and collects placements."""

    def __init__(self, data: Path, scene: TrackScene) -> None:
        self.data, self.scene, self.things = data, scene, 0

    def place(self, root: ET.Element, folder: Path, outer: NDArray[np.float64], thing: int | None) -> None:
        """thing: what all meshes below belong to; None: each element is a thing of its own."""
        levels = _nearest_levels(root)
        for element in _seen(root):
            if element.tag == "library":
                self._library(element, outer, thing)
                continue
            model = element.get("model")
            if element.get("lod_instance") == "true":
                model = levels.get(element.get("lod_group"), model)
            if model is None or "nvisible" in model or not model.endswith(".spm"):
                continue
            path = find_file(model, folder)
            if path is None:
                self.scene.missing.append(model)
                continue
            number = -1 if element.tag == "track" else self._next() if thing is None else thing
            self._add(Placement(path, outer @ _matrix(element, folder), number))

    def _library(self, element: ET.Element, outer: NDArray[np.float64], thing: int | None) -> None:
        name = element.get("name") or ""
        folder = self.data / "library" / name
        if not re.fullmatch(r"[\w.-]+", name) or not (folder / "node.xml").is_file():
            self.scene.missing.append(name)
            return
        if thing is not None:
            return  # things of the library are not nested in practice, and a cycle would never end
        matrix = outer @ _matrix(element, self.scene.folder)
        self.place(read_xml(folder / "node.xml"), folder, matrix, thing=self._next())

    def _next(self) -> int:
        self.things += 1
        return self.things - 1

    def _add(self, placement: Placement) -> None:
        self.scene.placements.append(placement)
        if len(self.scene.placements) > MAX_PLACEMENTS:
            raise InputError(f"{self.scene.folder}/scene.xml places more than {MAX_PLACEMENTS} meshes; is it damaged?")


def _seen(element: ET.Element) -> list[ET.Element]:
    """Elements in document order that place something to be seen; levels of detail are looked up by name instead."""
    found: list[ET.Element] = []
    for child in element:
        if child.tag == "lod" or child.get("if") not in _CONDITIONS or child.get("interaction") in _NOT_SEEN:
            continue
        if child.tag in ("track", "static-object", "library") or (
            child.tag == "object" and child.get("type") in ("animation", "movable")
        ):
            found.append(child)
        found += _seen(child)
    return found


def _nearest_levels(root: ET.Element) -> dict[str | None, str]:
    """The most detailed mesh of each group of levels of detail."""
    nearest: dict[str | None, tuple[float, str]] = {}
    for element in root.iterfind("./lod/group/*"):
        name, model = element.get("lod_group"), element.get("model")
        if model is not None:
            distance = float(element.get("lod_distance", "0"))
            nearest[name] = min(nearest.get(name, (np.inf, "")), (distance, model))
    return {name: model for name, (_, model) in nearest.items()}


def _matrix(element: ET.Element, folder: Path) -> NDArray[np.float64]:
    """(4, 4): scale, then turns about the file's x, y and z axis (degrees), then the shift."""
    shift, turns, scale = (
        _three(element, name, default, folder) for name, default in (("xyz", 0.0), ("hpr", 0.0), ("scale", 1.0))
    )
    matrix = np.diag([*scale, 1.0])
    for axis, angle in enumerate(np.radians(turns)):
        turn, (i, j) = np.eye(4), [(1, 2), (2, 0), (0, 1)][axis]
        turn[i, i] = turn[j, j] = np.cos(angle)
        turn[i, j], turn[j, i] = -np.sin(angle), np.sin(angle)
        matrix = turn @ matrix
    matrix[:3, 3] = shift
    return matrix


def _three(element: ET.Element, name: str, default: float, folder: Path) -> NDArray[np.float64]:
    """Three numbers of an attribute; a single one stands for all three."""
    text = element.get(name)
    if text is None:
        return np.full(3, default)
    return numbers(text, folder, 3)


def numbers(text: str, folder: Path, count: int) -> NDArray[np.float64]:
    """`count` finite numbers; raises InputError otherwise."""
    try:
        values = np.array([float(part) for part in text.split()])
    except ValueError:
        values = np.zeros(0)
    if len(values) == 1:
        values = np.repeat(values, count)
    if len(values) != count or not np.isfinite(values).all():
        raise InputError(f"{folder} has a scene file with '{text}' where {count} numbers belong; fetch it again.")
    return values


def _ground(folder: Path) -> NDArray[np.float64]:
    """(P, 3) world points in the middle of the drive line's far edges, or of an arena's faces."""
    points: list[NDArray[np.float64]] = []
    if (folder / "quads.xml").is_file():
        for quad in read_xml(folder / "quads.xml").iter("quad"):
            left, right = quad.get("p3", ":"), quad.get("p2", ":")
            if ":" not in left + right:  # "12:3" repeats a corner of another quad: the line closes there
                points.append((numbers(left, folder, 3) + numbers(right, folder, 3)) / 2)
    elif (folder / "navmesh.xml").is_file():
        root = read_xml(folder / "navmesh.xml")
        corners = [numbers(" ".join(v.get(a, "") for a in "xyz"), folder, 3) for v in root.iter("vertex")]
        for face in root.iter("face"):
            chosen = [int(i) for i in face.get("indices", "").split() if i.isdigit()]
            if chosen and max(chosen) < len(corners):
                points.append(np.mean([corners[i] for i in chosen], 0))
    return np.array(points).reshape(-1, 3) @ WORLD_FROM_FILE[:3, :3].T


def _read_sky(root: ET.Element, data: Path, scene: TrackScene) -> None:
    box, color = root.find("sky-box"), root.find("sky-color")
    if box is not None:
        files = [find_file(name, scene.folder, *texture_folders(data)) for name in (box.get("texture") or "").split()]
        scene.sky = [f for f in files if f is not None] if len(files) == 6 and None not in files else None
    if color is not None:
        red, green, blue = numbers(color.get("rgb", ""), scene.folder, 3) / 255
        scene.sky_color = (float(red), float(green), float(blue))
