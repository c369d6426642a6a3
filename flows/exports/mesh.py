"""TSDF fusion of rendered depth into one coloured triangle mesh (Open3D), and its files (PLY, GLB).

Curless and Levoy 1996, on sparse voxel blocks (Open3D's VoxelBlockGrid).
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from cat3d_core.cameras import Cameras
from cat3d_core.normalization import Similarity
from cat3d_core.rays import image_rays
from flows.errors import InputError
from flows.exports.ply import write_ply
from flows.open3d_import import import_open3d
from schemas.documents import write_bytes

BLOCK = 8  # voxels per block side
TRUNCATION = 5.0  # voxels, as zipnerf-pytorch's tsdf.py


class Mesh(NamedTuple):
    """vertices (P, 3), unit normals (P, 3) outwards, sRGB colours (P, 3) uint8; faces (F, 3) int32, counter-clockwise
    from outside."""

    vertices: np.ndarray
    normals: np.ndarray
    colours: np.ndarray
    faces: np.ndarray

    def mapped(self, similarity: Similarity) -> Mesh:
        """The mesh in another frame."""
        vertices = similarity.points(torch.from_numpy(self.vertices).double()).numpy()
        normals = (torch.from_numpy(self.normals).double() @ similarity.rotation.T).numpy()
        return self._replace(vertices=vertices, normals=normals)


def fuse(
    views: Iterable[tuple[torch.Tensor, torch.Tensor]], cameras: Cameras, voxel: float, min_views: int = 2
) -> Mesh:
    """Fuse one (depth (H, W), image (H, W, 3) in [0, 1]) per camera; a depth of 0 is no surface.

    Depth is z-depth in the unit of the cameras, and so is `voxel`, the side of a voxel; the images may be coarser or
    finer than the cameras'. Surface that fewer than `min_views` views confirm is left out.
    Raises InputError where nothing is left.
    """
    o3d = import_open3d("Meshes")
    core = o3d.core
    grid = o3d.t.geometry.VoxelBlockGrid(
        ("tsdf", "weight", "color"), (core.float32,) * 3, ((1), (1), (3)), voxel, BLOCK, 10_000
    )
    seen = 0
    for index, (depth, image) in enumerate(views):
        if not (depth > 0).any():
            continue
        seen += 1
        height, width = depth.shape
        camera = cameras[index].to(dtype=torch.float64).resize(width, height)
        rays = image_rays(camera, 0)
        points = (rays.origins + depth.double().reshape(-1, 1) * rays.directions)[depth.reshape(-1) > 0]
        cloud = o3d.t.geometry.PointCloud(core.Tensor(points.float().numpy()))
        # Blocks round every point: from a depth image Open3D takes every fourth pixel only.
        blocks = grid.compute_unique_block_coordinates(cloud, TRUNCATION)
        grid.integrate(
            blocks,
            o3d.t.geometry.Image(core.Tensor(depth.float().contiguous().numpy())),
            o3d.t.geometry.Image(core.Tensor(image.float().contiguous().numpy())),
            core.Tensor(camera.intrinsics[0].numpy()),
            core.Tensor(camera.camera_from_world[0].numpy()),
            1.0,
            float(depth.max()) * 2,
            TRUNCATION,
        )
    if not seen:
        raise InputError(
            "There is no surface to make a mesh of: no rendered pixel is opaque within the radius. Train longer, or "
            "lower --opacity or raise --radius."
        )
    # A voxel weighs as many views as see it; Open3D keeps those above the threshold.
    extracted = grid.extract_triangle_mesh(min(min_views, seen) - 0.5)
    faces = extracted.triangle.indices.numpy().astype(np.int32)
    if not len(faces):
        raise InputError(
            f"The {seen} views agree on no surface, so the mesh is empty. Train longer, or make the voxels larger "
            "(a lower --resolution)."
        )
    extracted.compute_vertex_normals()
    colours = (extracted.vertex.colors.numpy().clip(0, 1) * 255 + 0.5).astype(np.uint8)
    return Mesh(extracted.vertex.positions.numpy(), extracted.vertex.normals.numpy(), colours, faces)


def without_crumbs(mesh: Mesh, share: float = 0.002) -> Mesh:
    """The mesh without connected pieces of less than `share` of its faces (floaters)."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    a, b = mesh.faces[:, [0, 1]].reshape(-1), mesh.faces[:, [1, 2]].reshape(-1)
    count = len(mesh.vertices)
    _, piece = connected_components(coo_matrix((np.ones(len(a), bool), (a, b)), (count, count)), directed=False)
    piece_of_face = piece[mesh.faces[:, 0]]
    large = np.bincount(piece_of_face, minlength=piece.max() + 1) >= share * len(mesh.faces)
    faces = mesh.faces[large[piece_of_face]]
    used, faces = np.unique(faces, return_inverse=True)
    return Mesh(mesh.vertices[used], mesh.normals[used], mesh.colours[used], faces.reshape(-1, 3).astype(np.int32))


def write_mesh_ply(path: Path, mesh: Mesh) -> None:
    """Binary PLY with normals and sRGB colours per vertex."""
    write_ply(path, mesh.vertices, mesh.normals, mesh.colours, mesh.faces)


def write_mesh_glb(path: Path, mesh: Mesh) -> None:
    """Binary glTF with colours per vertex, which glTF defines as linear: sRGB is decoded (IEC 61966-2-1).

    Coordinates are those of the PLY file; the axes are not turned to glTF's +y up.
    """
    import trimesh

    x = mesh.colours / 255
    linear = np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)
    colours = (linear * 255 + 0.5).astype(np.uint8)
    shape = trimesh.Trimesh(
        mesh.vertices, mesh.faces, vertex_normals=mesh.normals, vertex_colors=colours, process=False
    )
    write_bytes(path, trimesh.exchange.gltf.export_glb(trimesh.Scene(shape)))
