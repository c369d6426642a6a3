"""A package of worlds in miniature, written by the tests: one track, a floor, a wall with a picture, a box, leaves."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from flows.training.worlds.package import COPYRIGHT, DATA

# File axes: x right, y up, z ahead (left-handed).
FLOOR = [(-40, 0, -40), (40, 0, -40), (40, 0, 40), (-40, 0, 40)]
WALL = [(-4, 0, 10), (4, 0, 10), (4, 4, 10), (-4, 4, 10)]
UV = [(0.0, 1.0), (1.0, 1.0), (1.0, 0.0), (0.0, 0.0)]


def spm(
    points: list[tuple[float, float, float]], texture: str = "",
    colors: list[tuple[int, int, int] | None] | None = None, triangles: tuple[int, ...] = (0, 3, 1, 1, 3, 2),
) -> bytes:  # fmt: skip
    """The bytes of a static mesh; a colour of None is stored as white."""
    flags = 2 if colors else 0
    out = b"SP" + bytes([1 << 3 | 2, flags]) + struct.pack("<6f", *([0] * 6)) + struct.pack("<H", 1)
    out += bytes([len(texture)]) + texture.encode() + b"\0" + struct.pack("<HH", 1, 1)
    out += struct.pack("<IIH", len(points), len(triangles), 0)
    for number, point in enumerate(points):
        out += struct.pack("<3f", *point)
        if colors:
            color = colors[number]
            out += b"\x80" if color is None else b"\0" + bytes(color)
        if texture:
            out += np.array(UV[number % 4], "<f2").tobytes()
    return out + bytes(triangles)


def box(low: tuple[float, float, float], high: tuple[float, float, float]) -> bytes:
    """A box of six faces that look outwards."""
    corners = [(x, y, z) for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])]
    faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return spm(corners, triangles=tuple(i for a, b, c, d in faces for i in (a, b, c, a, c, d)))


def write_package(folder: Path, track: str = "mini") -> Path:
    """The folder, as if the package had been unpacked there."""
    data = folder / DATA
    place = data / "tracks" / track
    (data / "textures").mkdir(parents=True)
    (data / "library" / "post").mkdir(parents=True)
    place.mkdir(parents=True)
    (folder / COPYRIGHT).parent.mkdir(parents=True)
    (folder / COPYRIGHT).write_text(
        "Format: x\n\nFiles: *\nCopyright: 2006-2022 The Team\nLicense: GPL-3+\n\n"
        "Files:\n data/textures/picture.png\nCopyright:\n 2011 Ann Painter <ann@example.org>\nLicense: CC-BY-SA-3.0\n"
    )
    picture = np.zeros((64, 64, 3), np.uint8)
    picture[:32, :32], picture[:32, 32:], picture[32:, :32] = (255, 0, 0), (0, 255, 0), (0, 0, 255)
    Image.fromarray(picture).save(data / "textures" / "picture.png")
    leaves = np.full((64, 64, 4), 255, np.uint8)
    leaves[:, :32, 3] = 0
    Image.fromarray(leaves).save(place / "leaves.png")
    (place / "materials.xml").write_text('<materials><material name="leaves.png" shader="alphatest"/></materials>')
    (place / "floor.spm").write_bytes(spm(FLOOR))
    (place / "wall.spm").write_bytes(spm(WALL, "picture.png"))
    (place / "leaves.spm").write_bytes(spm([(x, y, 9.0) for x, y, _ in WALL], "leaves.png"))
    (data / "library" / "post" / "post.spm").write_bytes(box((-0.5, 0, -0.5), (0.5, 2, 0.5)))
    (data / "library" / "post" / "node.xml").write_text(
        '<scene><object type="animation" model="post.spm" xyz="0 0 0" hpr="0 0 0" scale="1 1 1"/></scene>'
    )
    posts = "".join(f'<library name="post" xyz="{x} 0 {z}"/>' for x, z in ((8, 3), (-8, 2), (9, -7), (-6, -8)))
    (place / "scene.xml").write_text(
        f'<scene><track model="floor.spm"><static-object model="wall.spm" xyz="0 0 0"/>{posts}'
        '<static-object model="gone.spm"/><static-object model="../../../etc/passwd.spm"/>'
        '<static-object model="wall.spm" xyz="0 0 -3" interaction="physics-only"/></track>'
        '<sky-color rgb="255 0 0"/></scene>'
    )
    quads = "".join(f'<quad p0="0 0 0" p1="0 0 0" p2="1 0 {z}" p3="-1 0 {z}"/>' for z in range(-5, 6))
    (place / "quads.xml").write_text(f"<quads>{quads}<quad p0='0:1' p1='0:1' p2='0:3' p3='0:2'/></quads>")
    return folder


@pytest.fixture(scope="session")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The miniature package, unpacked; its one track is called mini."""
    return write_package(tmp_path_factory.mktemp("package"))


@pytest.fixture
def mesh_bytes():
    """The function that writes a mesh's bytes."""
    return spm
