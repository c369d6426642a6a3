"""Renders along any camera path: a JSON file of poses -> PNG images and mp4 videos."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from cat3d_core.cameras import Cameras
from flows.errors import InputError
from flows.exports.source import Source, render_views
from flows.media.images import read_image, write_png
from flows.media.pictures import depth_picture
from flows.media.video import write_video
from flows.readers.parsing import from_opengl, load_json, numbers

LARGEST_SIDE = 8192


@dataclass(frozen=True)
class CameraPath:
    """cameras (N), all of one size, in the frame of the file; frames per second of the video."""

    cameras: Cameras
    fps: float


def read_path(path: Path, width: int, height: int) -> CameraPath:
    """Read a camera path: a list of {"world_from_camera": 4x4 (OpenCV axes), "fov": vertical, degrees}, or an object
    with that list as "frames" and optionally "width", "height" (pixels; default: as given) and "fps"; or nerfstudio's
    camera_path.json, whose poses are taken to be in the same frame.

    Raises InputError naming the frame that cannot be used.
    """
    return parse_path(load_json(path), path, width, height)


def parse_path(document: Any, path: Path | str, width: int, height: int) -> CameraPath:
    """`read_path` of what its file holds; `path` names it in errors."""
    header: dict[str, Any] = document if isinstance(document, dict) else {"frames": document}
    if "camera_path" in header:
        header = _from_nerfstudio(header, path)
    frames = header.get("frames")
    if not isinstance(frames, list) or not frames:
        raise InputError(f'{path} holds no list of frames; write [{{"world_from_camera": 4x4, "fov": degrees}}, ...].')
    sizes = [header.get("width", width), header.get("height", height)]
    if not all(isinstance(side, int) and 1 <= side <= LARGEST_SIDE for side in sizes):
        raise InputError(f"{path}: width and height must be whole numbers from 1 to {LARGEST_SIDE}; got {sizes}.")
    fps = header.get("fps", 30)
    if not isinstance(fps, (int, float)) or not 0 < fps <= 1000:
        raise InputError(f"{path}: fps is {fps!r}; expected a number above 0.")
    poses, intrinsics = [], []
    for i, frame in enumerate(frames):
        if not isinstance(frame, dict) or not {"world_from_camera", "fov"} <= frame.keys():
            raise InputError(f'{path}: frame {i} needs "world_from_camera" (4x4) and "fov" (vertical, degrees).')
        fov = float(numbers(frame["fov"], (), f"fov of frame {i}", path))
        if not 0 < fov < 180:
            raise InputError(f"{path}: the fov of frame {i} is {fov:g}; expected degrees between 0 and 180.")
        poses.append(numbers(frame["world_from_camera"], (4, 4), f"world_from_camera of frame {i}", path))
        focal = sizes[1] / (2 * math.tan(math.radians(fov) / 2))
        k = [[focal, 0, sizes[0] / 2], [0, focal, sizes[1] / 2], [0, 0, 1]]
        intrinsics.append(torch.tensor(k, dtype=torch.float64))
    cameras = Cameras(torch.stack(intrinsics), torch.stack(poses), torch.tensor([sizes] * len(poses)))
    try:
        cameras.validate([f"frame {i}" for i in range(len(cameras))])
    except ValueError as error:
        raise InputError(f"{path}: {error}") from None
    return CameraPath(cameras, float(fps))


def _from_nerfstudio(document: dict[str, Any], path: Path | str) -> dict[str, Any]:
    """nerfstudio's camera_path.json as our document. Raises InputError for what is not a perspective path."""
    kind, cameras = document.get("camera_type", "perspective"), document["camera_path"]
    if kind != "perspective":
        raise InputError(f"{path} is a path of {kind} cameras; only perspective ones can be rendered.")
    if not isinstance(cameras, list) or not all(isinstance(camera, dict) for camera in cameras):
        raise InputError(f'{path}: "camera_path" is not a list of cameras.')
    frames = []
    for i, camera in enumerate(cameras):
        pose = numbers(camera.get("camera_to_world"), (16,), f"camera_to_world of camera {i}", path)
        frames.append({"world_from_camera": from_opengl(pose.view(1, 4, 4))[0].tolist(), "fov": camera.get("fov")})
    found = {"frames": frames, "fps": document.get("fps", 30)}
    sizes = {"width": document.get("render_width"), "height": document.get("render_height")}
    return found | {name: size for name, size in sizes.items() if size is not None}


def write_renders(source: Source, path: CameraPath, folder: Path) -> int:
    """Render a path given in the source's export frame; the number of frames.

    Of each frame frame_0000.png, depth_0000.png (median), normals_0000.png (along the axes of the path's frame, -1
    to 1 as black to white) and opacity_0000.png; of the path the videos path.mp4, depth.mp4 and normals.mp4.
    """
    folder.mkdir(parents=True, exist_ok=True)
    cameras = source.frame_from_scene.inverse().cameras(path.cameras)
    axes = source.frame_from_scene.rotation.float()
    depths = []
    for i, render in enumerate(render_views(source, cameras)):
        depths.append(render.depth.numpy())
        pictures = {"frame": render.image, "normals": 0.5 + 0.5 * render.normals @ axes.T, "opacity": render.opacity}
        for kind, picture in pictures.items():
            write_png(folder / f"{kind}_{i:04d}.png", picture)
    # One range of depths for the whole path, so that colours do not flicker.
    near, far = np.quantile(np.stack(depths), [0.01, 0.95])
    for i, depth in enumerate(depths):
        write_png(folder / f"depth_{i:04d}.png", depth_picture(depth, float(near), float(far)))
    for kind, name in (("frame", "path"), ("depth", "depth"), ("normals", "normals")):
        frames = (read_image(folder / f"{kind}_{i:04d}.png")[0] for i in range(len(depths)))
        write_video(folder / f"{name}.mp4", frames, path.fps)
    return len(depths)
