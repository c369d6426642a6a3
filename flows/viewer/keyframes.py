"""Keyframes of a browser as a smooth camera path, in our path format and in nerfstudio's."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from cat3d_core.cameras import Cameras
from cat3d_core.normalization import Similarity
from cat3d_core.splines import rotation_angle, rotation_spline, vector_spline
from flows.readers.parsing import from_opengl
from flows.viewer.cameras import vertical_fov

FPS = 30
TURN = 1.0
"""Radians of turning that take as long as one scene unit of moving."""


def smooth_path(keyframes: Sequence[Cameras], frames: int, closed: bool = False) -> Cameras:
    """`frames` cameras of the first keyframe's size through all keyframes (batches of one), at an even pace.

    closed: from the last keyframe on to the first. Raises ValueError for fewer than two keyframes or frames.
    """
    if len(keyframes) < 2 or frames < 2:
        raise ValueError(f"A path needs two keyframes and two frames; these are {len(keyframes)} and {frames}.")
    every = Cameras.cat([camera.to(dtype=torch.float64) for camera in [*keyframes, *(keyframes[:1] if closed else [])]])
    moved = every.centers.diff(dim=0).norm(dim=-1)
    turned = rotation_angle(every.rotation[:-1], every.rotation[1:])
    steps = (moved + turned / TURN).clamp_min(1e-6)
    knots = torch.cat([steps.new_zeros(1), steps.cumsum(0)])
    t = torch.linspace(0, 1, frames + closed, dtype=torch.float64)[:frames] * knots[-1]
    width, height = (int(side) for side in keyframes[0].size[0])
    fov = torch.tensor([vertical_fov(every[i]) for i in range(len(every))], dtype=torch.float64)
    focal = height / (2 * torch.tan(vector_spline(knots, fov[:, None], t)[:, 0] / 2))
    k = torch.zeros((frames, 3, 3), dtype=torch.float64)
    k[:, 0, 0] = k[:, 1, 1] = focal
    k[:, 0, 2], k[:, 1, 2], k[:, 2, 2] = width / 2, height / 2, 1
    pose = torch.eye(4, dtype=torch.float64).repeat(frames, 1, 1)
    pose[:, :3, :3] = rotation_spline(knots, every.rotation, t)
    pose[:, :3, 3] = vector_spline(knots, every.centers, t)
    return Cameras(k, pose, torch.tensor([[width, height]]).expand(frames, 2))


def path_document(path: Cameras, frame_from_scene: Similarity, fps: float = FPS) -> dict[str, Any]:
    """Our path format (flows/exports/path.py) of cameras of the scene frame, in another frame."""
    poses, fov, (width, height) = _parts(path, frame_from_scene)
    frames = [{"world_from_camera": pose.tolist(), "fov": angle} for pose, angle in zip(poses, fov, strict=True)]
    return {"width": width, "height": height, "fps": fps, "frames": frames}


def nerfstudio_document(path: Cameras, frame_from_scene: Similarity, fps: float = FPS) -> dict[str, Any]:
    """nerfstudio's camera_path.json of cameras of the scene frame, in another frame: OpenGL camera axes."""
    poses, fov, (width, height) = _parts(path, frame_from_scene)
    cameras = [
        {"camera_to_world": pose.reshape(-1).tolist(), "fov": angle, "aspect": width / height}
        for pose, angle in zip(from_opengl(poses), fov, strict=True)  # turning the axes is its own inverse
    ]
    return {
        "camera_type": "perspective", "render_width": width, "render_height": height, "fps": fps,
        "seconds": len(cameras) / fps, "is_cycle": False, "smoothness_value": 0, "keyframes": [],
        "camera_path": cameras,
    }  # fmt: skip


def _parts(path: Cameras, frame_from_scene: Similarity) -> tuple[Tensor, list[float], tuple[int, int]]:
    moved = frame_from_scene.cameras(path.to(dtype=torch.float64))
    fov = [math.degrees(vertical_fov(path[i])) for i in range(len(path))]
    width, height = (int(side) for side in path.size[0])
    return moved.world_from_camera, fov, (width, height)


def as_bytes(document: dict[str, Any]) -> bytes:
    """The file of a path."""
    return json.dumps(document, indent=1).encode()
