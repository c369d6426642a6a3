"""Sky and sun of a capture, and the light that a surface sends to the camera."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flows.training.worlds.scene import TrackScene
from flows.training.worlds.textures import LINEAR_FROM_SRGB, read_texture
from flows.training.worlds.world import Hits, World, dot

# Of each face of a sky box (top, bottom, east, west, south, north): where it lies, and where the right and the lower
# edge of its picture point, seen from inside. East is +x, north +y.
_FACES = np.array(
    [
        [[0, 0, 1], [0, -1, 0], [1, 0, 0]],
        [[0, 0, -1], [0, -1, 0], [-1, 0, 0]],
        [[1, 0, 0], [0, -1, 0], [0, 0, -1]],
        [[-1, 0, 0], [0, 1, 0], [0, 0, -1]],
        [[0, -1, 0], [-1, 0, 0], [0, 0, -1]],
        [[0, 1, 0], [1, 0, 0], [0, 0, -1]],
    ],
    np.float32,
)
_SHADOW_BIAS = 2e-3


@dataclass(frozen=True)
class Sky:
    """Linear colour of every direction: faces (6, S, S, 3), in the order of _FACES, or one colour in all of them."""

    faces: NDArray[np.float32]

    @staticmethod
    def of(scene: TrackScene) -> Sky:
        """The track's sky box, or its plain colour."""
        if scene.sky is None:
            color = LINEAR_FROM_SRGB[(255 * np.array(scene.sky_color)).clip(0, 255).astype(np.uint8)]
            return Sky(np.broadcast_to(color, (6, 1, 1, 3)))
        images = [read_texture(path, max_side=256) for path in scene.sky]
        side = min(min(image.shape[:2]) for image in images)
        images = [image[:: image.shape[0] // side, :: image.shape[1] // side, :3] for image in images]
        return Sky(LINEAR_FROM_SRGB[np.stack(images)])

    def __call__(self, directions: NDArray) -> NDArray[np.float32]:
        """(R, 3) colours of directions (R, 3) of any length, bilinear."""
        axis = np.abs(directions).argmax(-1)
        ahead = np.take_along_axis(directions, axis[:, None], 1)[:, 0]
        face = np.array([[3, 2], [4, 5], [1, 0]])[axis, (ahead > 0).astype(int)]
        s, t = np.einsum("rkc,rc->kr", _FACES[face, 1:], directions) / np.abs(ahead)
        side = self.faces.shape[1]
        x, y = (s + 1) / 2 * side - 0.5, (t + 1) / 2 * side - 0.5
        column, row = np.floor(x).astype(int), np.floor(y).astype(int)
        right, below = (x - column)[:, None], (y - row)[:, None]

        def texel(i: int, j: int) -> NDArray:
            return self.faces[face, (row + j).clip(0, side - 1), (column + i).clip(0, side - 1)]

        upper = (1 - right) * texel(0, 0) + right * texel(1, 0)
        return ((1 - below) * upper + below * ((1 - right) * texel(0, 1) + right * texel(1, 1))).astype(np.float32)


@dataclass(frozen=True)
class Light:
    """sun (3,): unit vector towards it; sun_color, above, below (3,): linear light of the sun, from the sky and from
    the ground; shadows: whether the sun throws any (indoors it stands for lamps and throws none)."""

    sun: NDArray[np.float64]
    sun_color: NDArray[np.float64]
    above: NDArray[np.float64]
    below: NDArray[np.float64]
    shadows: bool
    sky: Sky


def sunlit(world: World, points: NDArray, normals: NDArray, sun: NDArray) -> NDArray[np.bool_]:
    """(R,) whether the sun reaches points (R, 3) on surfaces with normals (R, 3): one more ray each, for those that
    face it."""
    facing = normals @ sun > 0
    reached = np.zeros(len(points), bool)
    rows = np.flatnonzero(facing)
    if len(rows):
        bias = _SHADOW_BIAS * (1 + 0.05 * np.abs(points[rows]).max(-1, keepdims=True))
        start = points[rows] + bias * normals[rows]
        reached[rows] = ~world.cast(start, np.broadcast_to(sun, start.shape)).found
    return reached


def radiance(world: World, hits: Hits, origins: NDArray, directions: NDArray, pixel: float, light: Light) -> NDArray:
    """(R, 3) linear light along rays (R, 3): Lambert's law under the sun, a sky above and ground below; the sky where
    nothing is hit. pixel: the angle between neighbouring rays, in radians, for the textures' filter."""
    out, rows, beyond = np.zeros((len(directions), 3), np.float32), np.flatnonzero(hits.found), ~hits.found
    out[beyond] = light.sky(directions[beyond])
    if not len(rows):
        return out
    met = Hits(hits.distance[rows], hits.triangle[rows], hits.weights[rows])
    d = directions[rows]
    length = np.sqrt(dot(d, d))
    points = origins[rows] + met.distance[:, None] * d
    face = world.face_normals[met.triangle]
    behind = dot(face, d)[:, None] > 0
    face, normal = np.where(behind, -face, face), world.shading_normals(met)
    normal = np.where(behind, -normal, normal)
    slant = np.abs(dot(face, d)) / length
    # Between the footprint's short side and its long one: less blur than the one, less flicker than the other.
    footprint = met.distance * length * pixel / np.sqrt(np.maximum(slant, 0.05))
    material = world.material[met.triangle]
    cosine = (normal @ light.sun).clip(0, 1)
    if light.shadows:
        cosine = cosine * sunlit(world, points, face, light.sun)
    up = (1 + normal[:, 2:]) / 2
    received = cosine[:, None] * light.sun_color + up * light.above + (1 - up) * light.below
    received = np.where(world.table.unlit[material][:, None], 1.0, received)
    out[rows] = world.albedo(met, footprint) * received
    return out
