"""A data set of posed images for other trainers (splats): a nerfstudio folder and a COLMAP text model in one."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from cat3d_core.cameras import Cameras
from flows.errors import InputError
from flows.exports.ply import write_ply
from flows.media.images import write_png
from flows.readers.parsing import from_opengl
from flows.sfm.colmap import pycolmap
from schemas.documents import write_bytes


def write_dataset(
    folder: Path, cameras: Cameras, images: Iterable[np.ndarray], captured_name: list[str | None],
    points: np.ndarray, normals: np.ndarray, colours: np.ndarray,
) -> list[str]:  # fmt: skip
    """Write images/*.png, transforms.json, sparse_pc.ply and sparse/0/*.txt; the names of the images.

    cameras (N), undistorted; images N x (h, w, 3) uint8; captured_name: the data set's own name of a captured view,
    None for a generated one; points (P, 3), normals, sRGB colours (P, 3) uint8 to start splats from, in the frame of
    the cameras. Raises InputError for a camera with skew, which neither format can say.
    """
    skewed = (cameras.intrinsics[:, 0, 1].abs() > 1e-6).nonzero().reshape(-1).tolist()
    if skewed:
        raise InputError(
            f"View {skewed[0]} has skewed pixels, which nerfstudio and COLMAP pinhole cameras cannot have."
        )
    kinds = ["generated" if name is None else "captured" for name in captured_name]
    names = [f"{kind}_{kinds[:i].count(kind):04d}.png" for i, kind in enumerate(kinds)]
    (folder / "images").mkdir(parents=True, exist_ok=True)
    for name, image in zip(names, images, strict=True):
        write_png(folder / "images" / name, image)
    write_ply(folder / "sparse_pc.ply", points, normals, colours)
    files = [f"images/{name}" for name in names]
    write_transforms(folder, cameras, files, kinds, captured_name, "sparse_pc.ply")
    write_colmap(folder / "sparse" / "0", cameras, names, points, colours)
    return names


def write_transforms(
    folder: Path, cameras: Cameras, files: list[str], kinds: list[str], captured_name: list[str | None],
    points: str | None = None,
) -> None:  # fmt: skip
    """transforms.json with intrinsics per frame and OpenGL camera axes (turning the axes is its own inverse). files:
    images, relative to the folder; kinds: what each is; points: a PLY file of points to start from."""
    poses = from_opengl(cameras.world_from_camera.double())
    frames = []
    for i, name in enumerate(files):
        k, (width, height) = cameras.intrinsics[i].double(), cameras.size[i].tolist()
        frames.append(
            {"file_path": name, "w": width, "h": height, "fl_x": float(k[0, 0]), "fl_y": float(k[1, 1]),
             "cx": float(k[0, 2]), "cy": float(k[1, 2]), "transform_matrix": poses[i].tolist(), "kind": kinds[i],
             "source_name": captured_name[i]}
        )  # fmt: skip
    document = {"camera_model": "PINHOLE"} | ({"ply_file_path": points} if points else {}) | {"frames": frames}
    write_bytes(folder / "transforms.json", json.dumps(document, indent=1).encode())


def write_colmap(folder: Path, cameras: Cameras, names: list[str], points: np.ndarray, colours: np.ndarray) -> None:
    """Text model: one PINHOLE camera per different lens, images without keypoints, points without tracks."""
    model = pycolmap.Reconstruction()
    lenses: dict[tuple[float, ...], int] = {}
    poses = cameras.camera_from_world.double().numpy()
    for i, name in enumerate(names):
        k, (width, height) = cameras.intrinsics[i].double(), cameras.size[i].tolist()
        lens = (width, height, *(float(k[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2))))
        if lens not in lenses:
            lenses[lens] = len(lenses) + 1
            model.add_camera_with_trivial_rig(
                pycolmap.Camera(
                    camera_id=lenses[lens], model="PINHOLE", width=width, height=height, params=list(lens[2:])
                )
            )
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(poses[i, :3, :3]), poses[i, :3, 3])
        model.add_image_with_trivial_frame(pycolmap.Image(name=name, camera_id=lenses[lens], image_id=i + 1), pose)
    for point, colour in zip(points, colours, strict=True):
        model.add_point3D(np.asarray(point, np.float64), pycolmap.Track(), colour)
    folder.mkdir(parents=True, exist_ok=True)
    model.write_text(str(folder))
