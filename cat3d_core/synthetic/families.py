"""Five families of random scenes that mimic the paper's data sets (Section 4.1 of the paper)."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from cat3d_core.synthetic.builder import SceneBuilder
from cat3d_core.synthetic.intersect import ground_height
from cat3d_core.synthetic.scene import Scene


def _sun(b: SceneBuilder) -> tuple[float, float, float, float]:
    azimuth, elevation = b.uniform(0, 2 * math.pi), b.uniform(0.5, 1.3)
    return (
        math.cos(azimuth) * math.cos(elevation),
        math.sin(azimuth) * math.cos(elevation),
        math.sin(elevation),
        0.0,
    )


def _lamp(b: SceneBuilder, spread: float, height: float) -> tuple[float, float, float, float]:
    return (b.uniform(-spread, spread), b.uniform(-spread, spread), height, 1.0)


def _height_function(b: SceneBuilder) -> Callable[[float, float], float]:
    def height(x: float, y: float) -> float:
        xy = torch.tensor([[[x], [y]]])
        # A little lower than the ground, so that nothing floats above a slope.
        return float(ground_height(b.waves[None], torch.tensor([b.flat_radius]), xy)) - 0.02

    return height


def _llff(b: SceneBuilder) -> Scene:
    """Forward-facing: things at several depths before a wall or open land; cameras on one side (LLFF)."""
    indoors = b.chance(0.5)
    b.add_ground(0.0 if indoors else b.uniform(0.0, 0.5), flat_radius=1.5)
    at = _height_function(b)
    b.stack_of_solids(b.uniform(-0.25, 0.25), b.uniform(-0.1, 0.3), 0.0, b.uniform(0.2, 0.38), b.draw.choice((1, 2, 3)))
    b.scatter(b.draw.randrange(3, 7), 0.4, 1.3, (0.1, 0.28), at, azimuth=(-0.15, math.pi + 0.15))
    if indoors:
        b.add("box", (0.0, b.uniform(1.6, 2.6), 1.9), (5.0, 0.1, 2.0), b.uniform(-0.2, 0.2))
        light = (b.uniform(-1.2, 1.2), b.uniform(-1.5, -0.3), b.uniform(1.6, 2.4), 1.0)
    else:
        b.scatter(4, 2.0, 4.5, (0.25, 0.8), at, azimuth=(0.3, math.pi - 0.3))
        light = _sun(b)
    return b.finish((0.0, 0.15, b.uniform(0.2, 0.4)), b.uniform(1.3, 1.9), light, indoors, 60.0 if indoors else 20.0)


def _dtu(b: SceneBuilder) -> Scene:
    """A few objects on a table before a plain backdrop; cameras on a part of the upper hemisphere (DTU)."""
    half = b.uniform(0.7, 1.6)
    if b.chance(0.5):
        b.add("cylinder", (0.0, 0.0, -0.05), (half, half, 0.05))
    else:
        b.add("box", (0.0, 0.0, -0.05), (half, half * b.uniform(0.7, 1.0), 0.05), b.uniform(-0.3, 0.3))
    b.footprints.clear()
    top = b.stack_of_solids(
        b.uniform(-0.1, 0.1), b.uniform(-0.1, 0.1), 0.0, b.uniform(0.18, 0.32), b.draw.choice((1, 2, 3))
    )
    b.scatter(b.draw.randrange(1, 5), 0.25, 0.55, (0.08, 0.2))
    light = _lamp(b, 1.0, b.uniform(1.3, 2.2))
    dark = b.chance(0.8)
    return b.finish((0.0, 0.0, 0.45 * top), b.uniform(1.0, 1.35), light, True, 1e4, 0.0 if dark else 0.6, dark_sky=dark)


def _co3d(b: SceneBuilder) -> Scene:
    """One object in its surroundings, seen from all around (CO3D)."""
    indoors = b.chance(0.6)
    if indoors:
        b.add_room((b.uniform(2.2, 3.4), b.uniform(2.2, 3.4), b.uniform(1.1, 1.6)))
    else:
        b.add_ground(b.uniform(0.0, 0.4), flat_radius=2.0)
    at = (lambda x, y: 0.0) if indoors else _height_function(b)
    base = 0.0
    if b.chance(0.5):
        base = b.uniform(0.1, 0.45)
        half = b.uniform(0.35, 0.6)
        kind = b.draw.choice(("box", "cylinder"))
        b.add(kind, (0.0, 0.0, base / 2), (half, half, base / 2), b.uniform(0, math.pi))
    top = b.stack_of_solids(0.0, 0.0, base, b.uniform(0.22, 0.36), b.draw.choice((1, 2, 2, 3)))
    b.scatter(b.draw.randrange(3, 7), 1.75, 2.2 if indoors else 4.0, (0.12, 0.3), at)
    light = _lamp(b, 1.5, 2.0) if indoors else _sun(b)
    return b.finish((0.0, 0.0, 0.55 * top + 0.45 * base), b.uniform(1.1, 1.4), light, indoors, 60.0)


def _re10k(b: SceneBuilder) -> Scene:
    """A furnished room, walked through (RealEstate10K)."""
    half = (b.uniform(1.6, 2.6), b.uniform(2.0, 3.2), b.uniform(0.9, 1.25))
    b.add_room(half)
    for side in b.draw.sample(range(4), b.draw.randrange(2, 5)):
        # Furniture along the walls, pictures and shelves above.
        along_x = side % 2 == 0
        length = half[0] if along_x else half[1]
        depth, height, width = b.uniform(0.15, 0.4), b.uniform(0.15, 0.8), b.uniform(0.2, 0.7)
        offset = b.uniform(-0.6, 0.6) * length
        wall = (half[1] if along_x else half[0]) * (1 if side < 2 else -1)
        inward = -math.copysign(1.0, wall)
        near = wall + inward * depth
        centre = (offset, near, height) if along_x else (near, offset, height)
        size = (width, depth, height) if along_x else (depth, width, height)
        b.add("box", centre, size)
        picture = b.uniform(-0.6, 0.6) * length
        z = b.uniform(0.9, 1.5) * half[2] / 1.1
        flat = wall + inward * 0.03
        tall, wide = b.uniform(0.15, 0.4), b.uniform(0.2, 0.5)
        b.add("box", (picture, flat, z) if along_x else (flat, picture, z),
              (wide, 0.03, tall) if along_x else (0.03, wide, tall))  # fmt: skip
    if b.chance(0.7):
        b.add(
            "box", (b.uniform(-0.5, 0.5), b.uniform(-0.5, 0.5), 0.01), (b.uniform(0.5, 1.0), b.uniform(0.5, 1.2), 0.01)
        )
        b.footprints.pop()
    b.scatter(b.draw.randrange(1, 4), 0.5, 1.5, (0.12, 0.25))
    light = _lamp(b, 0.8, half[2] * 1.75)
    return b.finish((0.0, 0.0, 0.85 * half[2]), min(half[0], half[1]), light, True, 1e4)


def _mip360(b: SceneBuilder) -> Scene:
    """A central group of objects in open land with far surroundings, orbited (mip-NeRF 360)."""
    b.add_ground(b.uniform(0.0, 0.9), flat_radius=2.5)
    at = _height_function(b)
    if b.chance(0.4):
        half = b.uniform(0.35, 0.6)
        table = b.uniform(0.2, 0.45)
        b.add(b.draw.choice(("box", "cylinder")), (0.0, 0.0, table / 2), (half, half, table / 2), b.uniform(0, math.pi))
        top = b.stack_of_solids(0.0, 0.0, table, b.uniform(0.15, 0.28), b.draw.choice((1, 2)))
    else:
        top = b.stack_of_solids(0.0, 0.0, 0.0, b.uniform(0.25, 0.45), b.draw.choice((1, 2, 3)))
    b.scatter(b.draw.randrange(1, 4), 0.6, 1.0, (0.1, 0.2), at)
    b.scatter(b.draw.randrange(4, 8), 2.3, 7.0, (0.3, 1.0), at)
    return b.finish((0.0, 0.0, 0.5 * top), b.uniform(1.4, 1.8), _sun(b), False, b.uniform(12.0, 40.0))


_RECIPES = {"llff": _llff, "dtu": _dtu, "co3d": _co3d, "re10k": _re10k, "mip360": _mip360}
FAMILIES = tuple(_RECIPES)


def random_scene(family: str, seed: int, textures: Tensor | None = None, texture_size: int = 128) -> Scene:
    """One random scene (a batch of one) of a family; the same seed gives the same scene everywhere.

    textures (M, 3, H, W) in [0, 1]: photographs to cut textures from, beside the procedural patterns.
    Raises ValueError for an unknown family or textures of another shape.
    """
    if family not in _RECIPES:
        raise ValueError(f"There is no scene family '{family}'; the families are {', '.join(FAMILIES)}.")
    if textures is not None and (textures.ndim != 4 or textures.shape[1] != 3 or len(textures) == 0):
        raise ValueError(
            f"Textures must be a (count, 3, height, width) tensor, and this one is {tuple(textures.shape)}."
        )
    return _RECIPES[family](SceneBuilder(family, seed, textures, texture_size))
