"""Where captures stand in a world: five kinds of camera groups, free space and sight checked by rays."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from flows.training.worlds.world import World, dot

Eyes = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Camera centres and what they look at, (C, 3) each, in order along the path."""

# Metres.
ORBIT_DISTANCE, ROUND_DISTANCE = (2.0, 6.0), (2.0, 10.0)
THING_SIZE = (0.5, 8.0)
EYE_HEIGHT = (0.8, 2.5)
CLEARANCE = 0.35
# What a bundle of rays from a free place meets from behind at most (it is nearly all of it inside a solid).
MAX_BACK_SHARE = 0.1
_CANDIDATES = 3


def _bundle(count: int) -> NDArray[np.float64]:
    """(count, 3) unit vectors, evenly over the sphere (Fibonacci spiral)."""
    z = 1 - (2 * np.arange(count) + 1) / count
    angle = math.pi * (1 + math.sqrt(5)) * np.arange(count)
    return np.stack([np.cos(angle) * np.sqrt(1 - z * z), np.sin(angle) * np.sqrt(1 - z * z), z], -1)


def free(world: World, eyes: NDArray, clearance: float = CLEARANCE) -> NDArray[np.bool_]:
    """(C,) whether places (C, 3) are `clearance` metres from every surface, and not inside a solid."""
    bundle = _bundle(40)
    origins = np.repeat(eyes, len(bundle), 0)
    directions = np.tile(bundle, (len(eyes), 1))
    hits = world.cast(origins, directions)
    behind = dot(world.face_normals[hits.triangle], directions) > 0
    behind = (behind & hits.found).reshape(len(eyes), -1)
    near = hits.distance.reshape(len(eyes), -1).min(1)
    found = hits.found.reshape(len(eyes), -1)
    return (near > clearance) & (behind.sum(1) <= MAX_BACK_SHARE * found.sum(1)) & found.any(1)


def sight(world: World, eyes: NDArray, places: NDArray, slack: NDArray | float) -> NDArray[np.bool_]:
    """(C,) whether nothing stands between eyes and places (C, 3) but within `slack` metres of the place."""
    way = places - eyes
    length = np.linalg.norm(way, axis=-1)
    return world.cast(eyes, way / np.maximum(length, 1e-9)[:, None]).distance > length - slack


def _stand(world: World, random: np.random.Generator) -> NDArray[np.float64]:
    return world.ground[random.integers(len(world.ground))] + [0, 0, random.uniform(*EYE_HEIGHT)]


def _ahead(random: np.random.Generator) -> NDArray[np.float64]:
    yaw, pitch = random.uniform(0, 2 * math.pi), math.radians(random.uniform(-22, 8))
    return np.array([math.cos(yaw) * math.cos(pitch), math.sin(yaw) * math.cos(pitch), math.sin(pitch)])


def _place_hit(world: World, random: np.random.Generator, near: float, far: float) -> tuple[NDArray, NDArray] | None:
    """A place to stand and a surface point seen from it, `near` to `far` metres away."""
    home = _stand(world, random)
    directions = np.stack([_ahead(random) for _ in range(8)])
    hits = world.cast(np.repeat(home[None], 8, 0), directions)
    for distance, direction in zip(hits.distance, directions, strict=True):
        if near < distance < far:
            return home, home + distance * direction
    return None


def _about(
    world: World, random: np.random.Generator, count: int, distance: tuple[float, float], turn: float, rise: float
) -> Eyes | None:
    """Cameras on a part `turn` (radians) of a circle about an object, or, where a world has none (and now and then),
    about a place that is seen; rise: highest elevation in radians."""
    reach = random.uniform(*distance)
    things = [t for t in world.things if THING_SIZE[0] < (t.high - t.low).max() < min(THING_SIZE[1], 1.4 * reach)]
    if things and random.random() < 0.8:
        thing = things[random.integers(len(things))]
        focus, radius = (thing.low + thing.high) / 2, float(np.linalg.norm(thing.high - thing.low)) / 2
        if reach < 0.8 * radius + 0.6:
            return None
    else:
        seen = _place_hit(world, random, *distance)
        if seen is None:
            return None
        focus, radius = seen[1], 0.15 * reach
    u = (np.arange(_CANDIDATES * count) + random.uniform(0, 1, _CANDIDATES * count)) / (_CANDIDATES * count)
    azimuth = random.uniform(0, 2 * math.pi) + turn * (u - 0.5)
    base = random.uniform(0.05, rise)
    elevation = (base + 0.12 * np.sin(azimuth * random.integers(1, 3)) + 0.06 * random.normal(size=len(u))).clip(
        0.03, 1.2
    )
    far = reach * (1 + random.uniform(0.02, 0.12) * random.normal(size=len(u)).clip(-2, 2))
    flat = np.cos(elevation)
    eyes = focus + far[:, None] * np.stack([np.cos(azimuth) * flat, np.sin(azimuth) * flat, np.sin(elevation)], -1)
    targets = focus + 0.06 * reach * random.normal(size=eyes.shape)
    keep = sight(world, eyes, np.broadcast_to(focus, eyes.shape), 1.1 * radius)
    return eyes[keep], targets[keep]


def orbit(world: World, random: np.random.Generator, count: int) -> Eyes | None:
    """A quarter to a half circle about an object, 2 to 6 metres away."""
    return _about(world, random, count, ORBIT_DISTANCE, math.radians(random.uniform(40, 180)), 0.8)


def round_(world: World, random: np.random.Generator, count: int) -> Eyes | None:
    """All round an object, 2 to 10 metres away."""
    return _about(world, random, count, ROUND_DISTANCE, math.radians(random.uniform(300, 360)), 0.6)


def forward(world: World, random: np.random.Generator, count: int) -> Eyes | None:
    """Side by side and one above the other, all facing the same place."""
    seen = _place_hit(world, random, 2.0, 25.0)
    if seen is None:
        return None
    home, aim = seen
    distance = float(np.linalg.norm(aim - home))
    ahead = (aim - home) / distance
    right = np.cross(ahead, [0, 0, 1])
    right /= max(float(np.linalg.norm(right)), 1e-6)
    up, candidates = np.cross(right, ahead), _CANDIDATES * count
    extent = random.uniform(0.1, 0.45) * distance
    side = np.sort(random.uniform(-1, 1, candidates))[:, None]
    bend = random.uniform(0, 0.5) * extent * side**2
    eyes = home + extent * (side * right + 0.5 * random.uniform(-1, 1, (candidates, 1)) * up)
    eyes = eyes + (bend + 0.15 * extent * random.uniform(-1, 1, (candidates, 1))) * ahead
    return _reached(world, home, eyes, aim + 0.08 * distance * random.normal(size=eyes.shape))


def walk(world: World, random: np.random.Generator, count: int) -> Eyes | None:
    """Along the drive line, looking ahead or to the side."""
    start = _stand(world, random)
    away = np.linalg.norm(world.ground - start, axis=-1)
    near = np.flatnonzero((away > 2.5) & (away < 25))
    if not len(near):
        return None
    end = world.ground[near[random.integers(len(near))]] + [0, 0, start[2] - world.ground[away.argmin(), 2]]
    length = random.uniform(1.2, 7.0)
    way = (end - start) / np.linalg.norm(end - start)
    side = np.array([-way[1], way[0], 0])
    u = (np.arange(_CANDIDATES * count) + random.uniform(0, 1, _CANDIDATES * count)) / (_CANDIDATES * count)
    bend = random.uniform(-0.25, 0.25) * length
    eyes = start + u[:, None] * length * way + (bend * 4 * u * (1 - u))[:, None] * side
    eyes = eyes + 0.03 * random.normal(size=eyes.shape)
    heading = math.atan2(way[1], way[0]) + random.uniform(-0.9, 0.9) + random.uniform(-0.8, 0.8) * (u - 0.5)
    heading = heading + 0.06 * random.normal(size=len(u))
    pitch = random.uniform(-0.2, 0.05) + 0.04 * random.normal(size=len(u))
    look = np.stack([np.cos(heading), np.sin(heading), np.tan(pitch)], -1)
    return _reached(world, start, eyes, eyes + 4 * look)


def look_around(world: World, random: np.random.Generator, count: int) -> Eyes | None:
    """Turning on the spot, with a step or two to the side."""
    home = _stand(world, random)
    u = (np.arange(_CANDIDATES * count) + random.uniform(0, 1, _CANDIDATES * count)) / (_CANDIDATES * count)
    heading = random.uniform(0, 2 * math.pi) + math.radians(random.uniform(50, 200)) * (u - 0.5)
    reach = random.uniform(0.2, 0.9)
    look = np.stack(
        [np.cos(heading), np.sin(heading), random.uniform(-0.25, 0.05) + 0.06 * random.normal(size=len(u))], -1
    )
    step = np.stack([look[:, 1], -look[:, 0], 0 * u], -1) * random.choice([-1, 1])
    eyes = home + reach * step * random.uniform(0.3, 1, (len(u), 1)) + 0.15 * reach * random.normal(size=look.shape)
    return _reached(world, home, eyes, eyes + 4 * look)


def _reached(world: World, home: NDArray, eyes: NDArray, targets: NDArray) -> Eyes | None:
    """Those cameras that one gets to from home without passing through anything."""
    keep = sight(world, np.broadcast_to(home, eyes.shape), eyes, -CLEARANCE)
    return eyes[keep], targets[keep]


PLACINGS: dict[str, Callable[[World, np.random.Generator, int], Eyes | None]] = {
    "forward": forward, "orbit": orbit, "look_around": look_around, "walk": walk, "round": round_,
}  # fmt: skip
KINDS = tuple(PLACINGS)


def place(world: World, kind: str, random: np.random.Generator, count: int) -> Eyes | None:
    """`count` cameras of a kind that stand free, in order along their path; None where this draw has no room."""
    drawn = PLACINGS[kind](world, random, count)
    if drawn is None or len(drawn[0]) < count:
        return None
    eyes, targets = drawn
    kept = np.flatnonzero(free(world, eyes))
    if len(kept) < count:
        return None
    chosen = kept[np.linspace(0, len(kept) - 1, count).round().astype(int)]
    return eyes[chosen], targets[chosen]
