"""A track that rays can hit: all triangles in one Embree scene, materials, a sun that casts shadows, a sky.

Frame: +z up, metres. Colours are linear light until `srgb_from_linear`."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flows.errors import InputError
from flows.open3d_import import import_open3d
from flows.training.worlds.materials import Kind, Materials
from flows.training.worlds.scene import Placement, TrackScene
from flows.training.worlds.spm import Buffer, read_spm
from flows.training.worlds.textures import Atlas

MAX_TRIANGLES = 12_000_000
# How many see-through surfaces a ray passes before it gets no further.
MAX_LAYERS = 12


@dataclass(frozen=True)
class Hits:
    """What R rays meet first. distance (R,) in units of the ray directions' lengths, inf for nothing; triangle (R,),
    -1 for nothing; weights (R, 3) of the triangle's corners."""

    distance: NDArray[np.float32]
    triangle: NDArray[np.int64]
    weights: NDArray[np.float32]

    @property
    def found(self) -> NDArray[np.bool_]:
        """(R,) where there is something."""
        return self.triangle >= 0


@dataclass(frozen=True)
class Thing:
    """An object that stands in the track: the corners (3,) of its box in the world."""

    low: NDArray[np.float64]
    high: NDArray[np.float64]


class World:
    """A track's triangles with their materials. things: the objects that stand in it; ground (P, 3): where one can
    stand; files: what it is made of.

    usable: whether a file of the package may be used; meshes that may not are left out, textures become grey."""

    def __init__(self, scene: TrackScene, data: Path, usable: Callable[[Path], bool] = lambda path: True) -> None:
        meshes, materials = _Meshes(), Materials(data, scene.folder, usable)
        boxes: dict[int, list[NDArray[np.float64]]] = defaultdict(list)
        loaded: dict[Path, list[Buffer]] = {}
        for placement in scene.placements:
            if not usable(placement.model):
                continue
            if placement.model not in loaded:
                loaded[placement.model] = read_spm(placement.model)
            for buffer in loaded[placement.model]:
                corners = meshes.add(buffer, placement, materials)
                if placement.thing >= 0 and corners is not None:
                    boxes[placement.thing].append(corners)
        if not meshes.triangles:
            raise InputError(f"{scene.folder} has no triangles to be seen.")
        self.triangles = np.concatenate(meshes.triangles)
        self.material = np.concatenate(meshes.material)
        points, self.normals, self.colors, self.uv, self.uv2 = (
            np.concatenate(part) for part in (meshes.points, meshes.normals, meshes.colors, meshes.uv, meshes.uv2)
        )
        self.things = [Thing(np.min(b, (0, 1)), np.max(b, (0, 1))) for b in boxes.values()]
        self.ground = scene.ground
        self.files = sorted(loaded) + materials.files()
        self.table, self.atlas = materials.table(), Atlas.of(*materials.images())
        corners = points[self.triangles].astype(np.float64)
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        area = np.linalg.norm(normal, axis=-1)
        self.face_normals = (normal / np.maximum(area, 1e-20)[:, None]).astype(np.float32)
        self.density = _texel_density(self, area)
        open3d = import_open3d("Worlds")
        self._tensor = open3d.core.Tensor
        self._embree = open3d.t.geometry.RaycastingScene(nthreads=1)
        self._embree.add_triangles(self._tensor(points), self._tensor(self.triangles.astype(np.uint32)))

    def cast(self, origins: NDArray, directions: NDArray) -> Hits:
        """First surfaces that are not see-through at the place hit; rays (R, 3) float, directions of any length."""
        rays = np.concatenate([origins, directions], -1).astype(np.float32)
        count = len(rays)
        hits = Hits(np.full(count, np.inf, np.float32), np.full(count, -1), np.zeros((count, 3), np.float32))
        rows, passed, length = np.arange(count), np.zeros(count, np.float32), np.sqrt(dot(rays[:, 3:], rays[:, 3:]))
        for layer in range(MAX_LAYERS):
            answer = self._embree.cast_rays(self._tensor(rays[rows]))
            step = answer["t_hit"].numpy()
            met = np.isfinite(step)
            rows, step = rows[met], step[met]
            triangle = answer["primitive_ids"].numpy()[met].astype(np.int64)
            uv = answer["primitive_uvs"].numpy()[met]
            weights = np.stack([1 - uv[:, 0] - uv[:, 1], uv[:, 0], uv[:, 1]], -1)
            solid = self._solid(triangle, weights) if layer < MAX_LAYERS - 1 else np.ones(len(rows), bool)
            done = rows[solid]
            hits.distance[done] = passed[done] + step[solid]
            hits.triangle[done], hits.weights[done] = triangle[solid], weights[solid]
            rows, step = rows[~solid], step[~solid]
            if not len(rows):
                break
            # Far enough behind the surface that the next cast doesn't meet it again.
            step = step + (1e-3 + 1e-5 * passed[rows]) / length[rows]
            passed[rows] += step
            rays[rows, :3] += step[:, None] * rays[rows, 3:]
        return hits

    def _solid(self, triangle: NDArray, weights: NDArray) -> NDArray[np.bool_]:
        kind = self.table.kind[self.material[triangle]]
        solid, tested = kind == Kind.SOLID, np.flatnonzero(kind == Kind.CUT_OUT)
        if len(tested):
            texture = self.table.texture[self.material[triangle[tested]]]
            uv = interpolate(self.uv, self.triangles[triangle[tested]], weights[tested])
            solid[tested] = self.atlas.opacity(texture, uv) > 0.5
        return solid

    def albedo(self, hits: Hits, footprint: NDArray) -> NDArray[np.float32]:
        """(R, 3) colour of hit surfaces (all must be found), filtered over footprint (R,), metres at the surface."""
        corners, material = self.triangles[hits.triangle], self.material[hits.triangle]
        uv = interpolate(self.uv, corners, hits.weights)
        level = np.log2(np.maximum(footprint * self.density[hits.triangle], 1))
        color = self.atlas.sample(self.table.texture[material], uv, level)
        blended = np.flatnonzero(self.table.blend[material] >= 0)
        if len(blended):
            color[blended] = self._splat(material[blended], uv[blended], corners[blended], hits, blended, level)
        return color * interpolate(self.colors, corners, hits.weights) / np.float32(255)

    def _splat(
        self, material: NDArray, uv: NDArray, corners: NDArray, hits: Hits, rows: NDArray, level: NDArray
    ) -> NDArray[np.float32]:
        """Four layers, weighted by the red, green and blue of a map and what they leave of 1."""
        where = interpolate(self.uv2, corners, hits.weights[rows])
        weights = self.atlas.sample(self.table.blend[material], where, level[rows] * 0)
        weights = np.concatenate([weights, (1 - weights.sum(-1, keepdims=True)).clip(0)], -1)
        total = np.zeros((len(rows), 3), np.float32)
        for layer in range(4):
            color = self.atlas.sample(self.table.layers[material, layer], uv, level[rows])
            total += weights[:, layer : layer + 1] * color
        return total / np.maximum(weights.sum(-1, keepdims=True), 1e-3)

    def shading_normals(self, hits: Hits) -> NDArray[np.float32]:
        """(R, 3) unit normals of hit surfaces, smooth where the mesh says so, on the side of the face's own."""
        smooth = interpolate(self.normals, self.triangles[hits.triangle], hits.weights)
        face = self.face_normals[hits.triangle]
        smooth = np.where(dot(smooth, face)[:, None] > 0.1, smooth, face)
        return smooth / np.maximum(np.sqrt(dot(smooth, smooth)), 1e-6)[:, None]


def dot(a: NDArray, b: NDArray) -> NDArray:
    """(R,) products of vectors (R, C)."""
    return np.einsum("rc,rc->r", a, b)


def interpolate(values: NDArray, corners: NDArray, weights: NDArray) -> NDArray[np.float32]:
    """(R, C) values (V, C) at corners (R, 3), weighted (R, 3)."""
    return np.einsum("rkc,rk->rc", values[corners].astype(np.float32), weights)


def _texel_density(world: World, area: NDArray) -> NDArray[np.float32]:
    """(T,) texels a metre of each triangle's texture at level 0; area (T,) twice its surface."""
    uv = world.uv[world.triangles].astype(np.float64)
    a, b = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    texture = world.table.texture[world.material]
    texels = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) * world.atlas.width[texture] * world.atlas.height[texture]
    return np.sqrt(texels / np.maximum(area, 1e-12)).astype(np.float32)


class _Meshes:
    """Buffers in the world frame, one after another."""

    def __init__(self) -> None:
        self.points: list[NDArray] = []
        self.normals: list[NDArray] = []
        self.colors: list[NDArray] = []
        self.uv: list[NDArray] = []
        self.uv2: list[NDArray] = []
        self.triangles: list[NDArray] = []
        self.material: list[NDArray] = []
        self.vertices = self.count = 0

    def add(self, buffer: Buffer, placement: Placement, materials: Materials) -> NDArray[np.float64] | None:
        """The lowest and highest corner (2, 3) of what can be seen of it; None for nothing."""
        number = materials.number(buffer.textures, placement.model.parent)
        if materials.kinds[number] == Kind.UNSEEN or not len(buffer.triangles):
            return None
        self.count += len(buffer.triangles)
        if self.count > MAX_TRIANGLES:
            raise InputError(f"{placement.model.parent}: more than {MAX_TRIANGLES} triangles; is a scene file damaged?")
        matrix = placement.matrix
        points = (buffer.points @ matrix[:3, :3].T + matrix[:3, 3]).astype(np.float32)
        triangles = buffer.triangles
        if np.linalg.det(matrix[:3, :3]) < 0:  # the exchange of axes mirrors: keep fronts in front
            triangles = triangles[:, ::-1]
        self.triangles.append(triangles + self.vertices)
        self.vertices += len(points)
        self.points.append(points)
        self.normals.append(_turned(buffer, matrix))
        self.colors.append(buffer.colors)
        self.uv.append(buffer.uv)
        self.uv2.append(buffer.uv2)
        self.material.append(np.full(len(triangles), number, np.int32))
        return np.stack([points.min(0), points.max(0)]).astype(np.float64)


def _turned(buffer: Buffer, matrix: NDArray[np.float64]) -> NDArray[np.float32]:
    """Normals (V, 3) in the world; zero where the mesh has none (then the face's own are taken)."""
    if buffer.normals is None:
        return np.zeros_like(buffer.points)
    linear = matrix[:3, :3]
    if abs(np.linalg.det(linear)) < 1e-12:
        return np.zeros_like(buffer.points)
    turned = buffer.normals @ np.linalg.inv(linear)
    return (turned / np.maximum(np.linalg.norm(turned, axis=-1, keepdims=True), 1e-9)).astype(np.float32)
