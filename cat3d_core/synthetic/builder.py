"""Puts objects, ground, room, light and sky together into one `Scene`."""

from __future__ import annotations

import math
import random

import torch
from torch import Tensor

from cat3d_core.random import derive_seed, generator
from cat3d_core.synthetic.scene import SLOTS, Scene, slot_range
from cat3d_core.synthetic.textures import photo_texture, procedural_texture, random_colour

WAVES = 5
_TEXTURES = 8


def _rotation(yaw: float, tilt: float) -> Tensor:
    """(3, 3) world-from-object: tilt about x, then yaw about z, in radians."""
    cy, sy, ct, st = math.cos(yaw), math.sin(yaw), math.cos(tilt), math.sin(tilt)
    turn = torch.tensor([[cy, -sy, 0.0], [sy, cy, 0.0], [0.0, 0.0, 1.0]])
    lean = torch.tensor([[1.0, 0.0, 0.0], [0.0, ct, -st], [0.0, st, ct]])
    return turn @ lean


class SceneBuilder:
    """Collects the parts of one random scene. `draw` gives plain random numbers, `generator` tensors of them; both
    depend on (seed, family) only."""

    def __init__(self, family: str, seed: int, photos: Tensor | None, texture_size: int) -> None:
        self.family = family
        self.draw = random.Random(derive_seed(seed, "synthetic", family))
        self.generator = generator(seed, "synthetic textures", family)
        count = sum(SLOTS.values())
        self.maps = torch.zeros(count, 3, 4)
        self.maps[:, :, :3] = torch.eye(3)
        self.half_size = torch.ones(count, 3)
        self.active = torch.zeros(count, dtype=torch.bool)
        self.texture = torch.zeros(count, dtype=torch.long)
        self.texture_scale = torch.ones(count)
        self.tint = torch.ones(count, 3)
        self.bias = torch.zeros(count, 3)
        self.gloss = torch.zeros(count)
        self.waves = torch.zeros(WAVES, 4)
        self.flat_radius = 1.0
        self.footprints: list[tuple[float, float, float]] = []
        self.textures = torch.stack([self._texture(photos, texture_size) for _ in range(_TEXTURES)])

    def uniform(self, low: float, high: float) -> float:
        return self.draw.uniform(low, high)

    def chance(self, probability: float) -> bool:
        return self.draw.random() < probability

    def _texture(self, photos: Tensor | None, size: int) -> Tensor:
        if photos is not None and self.chance(0.5):
            return photo_texture(photos, size, self.generator)
        return procedural_texture(size, self.generator)

    def _paint(self, slot: int, repeats: float) -> None:
        """A random texture, contrast, tint and gloss for one slot; `repeats` per world unit."""
        self.texture[slot] = self.draw.randrange(_TEXTURES)
        self.texture_scale[slot] = repeats
        colour = random_colour(self.generator)
        contrast = self.uniform(0.25, 1.0)
        self.tint[slot] = contrast * (0.5 + 0.5 * colour)
        self.bias[slot] = (1 - contrast) * colour
        self.gloss[slot] = self.uniform(0.1, 0.5) if self.chance(0.25) else 0.0

    def add(
        self,
        kind: str,
        centre: tuple[float, float, float],
        half_size: tuple[float, float, float],
        yaw: float = 0.0,
        tilt: float = 0.0,
    ) -> bool:
        """Place a solid (sphere, box, cylinder); False where its kind has no slot left."""
        slots = slot_range(kind)
        free = [s for s in range(slots.start, slots.stop) if not self.active[s]]
        if not free:
            return False
        slot = free[0]
        inverse = torch.diag(1 / torch.tensor(half_size)) @ _rotation(yaw, tilt).T
        self.maps[slot] = torch.cat([inverse, -inverse @ torch.tensor(centre)[:, None]], -1)
        self.half_size[slot] = torch.tensor(half_size)
        self.active[slot] = True
        self._paint(slot, self.uniform(0.3, 1.0) / max(half_size))
        self.footprints.append((centre[0], centre[1], math.hypot(half_size[0], half_size[1])))
        return True

    def clear_of_others(self, x: float, y: float, radius: float) -> bool:
        """True where a disc at (x, y) touches no footprint of a solid already placed."""
        return all(math.hypot(x - fx, y - fy) > radius + fr for fx, fy, fr in self.footprints)

    def add_ground(self, amplitude: float = 0.0, flat_radius: float = 1.0) -> None:
        """Ground through z = 0, level near the origin; `amplitude` is the rough height of its hills."""
        self.active[0] = True
        self._paint(0, self.uniform(0.25, 0.8))
        self.gloss[0] = 0.0
        self.flat_radius = flat_radius
        if amplitude > 0:
            for k in range(WAVES):
                angle, frequency = self.uniform(0, 2 * math.pi), self.uniform(0.4, 0.9) * (1 + 0.5 * k)
                self.waves[k] = torch.tensor(
                    [frequency * math.cos(angle), frequency * math.sin(angle), self.uniform(0, 2 * math.pi),
                     amplitude / WAVES / (1 + 0.5 * k)]
                )  # fmt: skip

    def add_room(self, half_size: tuple[float, float, float]) -> None:
        """A room around the origin with its floor at z = 0."""
        slot = slot_range("room").start
        self.active[slot] = True
        inverse = torch.diag(1 / torch.tensor(half_size))
        centre = torch.tensor([0.0, 0.0, half_size[2]])
        self.maps[slot] = torch.cat([inverse, -inverse @ centre[:, None]], -1)
        self.half_size[slot] = torch.tensor(half_size)
        self._paint(slot, self.uniform(0.2, 0.8))
        self.gloss[slot] = 0.0

    def stack_of_solids(self, x: float, y: float, base: float, radius: float, count: int) -> float:
        """`count` solids one on another at (x, y), all inside the given radius; the height of their top."""
        z = base
        for i in range(count):
            kind = self.draw.choice(("box", "cylinder", "sphere", "box"))
            r = radius * self.uniform(0.55, 0.95) * 0.85**i
            height = r * self.uniform(0.5, 1.5) * (1.0, 0.75, 0.6)[min(count, 3) - 1]
            yaw = self.uniform(0, 2 * math.pi)
            if kind == "sphere":
                height = r * self.uniform(0.7, 1.2)
                half = (r, r, height)
            elif kind == "cylinder":
                half = (r, r, height)
            else:
                half = (r * self.uniform(0.4, 0.72), r * self.uniform(0.4, 0.68), height)
            # A sphere sinks a little into what carries it, so that stacks don't balance on a point.
            lift = 0.9 * height if kind == "sphere" and i > 0 else height
            if not self.add(kind, (x, y, z + lift), half, yaw):
                return z
            z += lift + height
        return z

    def scatter(
        self, count: int, inner: float, outer: float, size: tuple[float, float], height_at=None, azimuth=None
    ) -> None:
        """Up to `count` small stacks at distances inner..outer from the origin, clear of one another.

        size: smallest and largest radius. height_at(x, y): the ground's height. azimuth: (low, high) in radians.
        """
        low, high = azimuth or (0.0, 2 * math.pi)
        for _ in range(count):
            for _ in range(12):
                angle, distance = self.uniform(low, high), self.uniform(inner, outer)
                x, y, radius = distance * math.cos(angle), distance * math.sin(angle), self.uniform(*size)
                if self.clear_of_others(x, y, radius):
                    base = height_at(x, y) if height_at else 0.0
                    self.stack_of_solids(x, y, base, radius, self.draw.choice((1, 1, 2, 3)))
                    break

    def finish(
        self, focus: tuple[float, float, float], reach: float, light: tuple[float, float, float, float],
        indoors: bool, haze_distance: float, panorama_weight: float | None = None, dark_sky: bool = False,
    ) -> Scene:  # fmt: skip
        """The scene, with random light colours and sky. light: homogeneous position of the key light."""
        warm = torch.tensor([1.0, self.uniform(0.85, 1.0), self.uniform(0.7, 1.0)])
        strength = self.uniform(0.7, 1.2)
        shade = self.uniform(0.45, 0.75)
        horizon = 0.5 + 0.5 * random_colour(self.generator)
        zenith = random_colour(self.generator) if self.chance(0.3) else torch.tensor([0.3, 0.5, 0.85]) * horizon
        if dark_sky:
            horizon = zenith = random_colour(self.generator) * self.uniform(0.05, 0.8)
        weight = self.draw.choice((0.0, 0.5, 0.9)) if panorama_weight is None else panorama_weight
        panorama = torch.tensor([self.draw.randrange(_TEXTURES), weight, self.draw.choice((1, 2, 3))])
        tensors = {
            "object_from_world": self.maps, "half_size": self.half_size, "active": self.active,
            "texture": self.texture, "texture_scale": self.texture_scale, "tint": self.tint, "bias": self.bias,
            "gloss": self.gloss, "waves": self.waves, "flat_radius": torch.tensor(self.flat_radius),
            "sky": torch.stack([zenith, horizon, horizon]), "panorama": panorama.float(),
            "haze_distance": torch.tensor(haze_distance), "light": torch.tensor(light),
            "light_colour": warm * strength * (1.0 if indoors else 0.9), "ambient": shade * (0.7 + 0.3 * horizon),
            "focus": torch.tensor(focus), "reach": torch.tensor(reach), "textures": self.textures,
        }  # fmt: skip
        return Scene((self.family,), **{name: tensor[None] for name, tensor in tensors.items()})
