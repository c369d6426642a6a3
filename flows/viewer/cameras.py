"""Between the browser's camera and ours: both look along z with x right and y down."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch

from cat3d_core.cameras import Cameras
from cat3d_core.quaternions import quaternions_from_rotations, rotation_matrices

LARGEST = 1280
"""Longer side in pixels of what is rendered for a browser, whatever the size of its window."""


def camera_of(wxyz: Any, position: Any, fov: float, width: int, height: int) -> Cameras:
    """One camera (scene frame) from a rotation, a centre, a vertical angle of view in radians and a window's size."""
    shrink = min(1.0, LARGEST / max(width, height, 1))
    width, height = max(1, round(width * shrink)), max(1, round(height * shrink))
    focal = height / (2 * math.tan(fov / 2))
    k = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], dtype=torch.float64)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = rotation_matrices(torch.as_tensor(np.asarray(wxyz), dtype=torch.float64))
    pose[:3, 3] = torch.as_tensor(np.asarray(position), dtype=torch.float64)
    return Cameras(k[None], pose[None], torch.tensor([[width, height]]))


def place(camera: Cameras) -> tuple[np.ndarray, np.ndarray]:
    """Quaternion w, x, y, z and centre of one camera."""
    rotation = quaternions_from_rotations(camera.rotation[0].double())
    return rotation.numpy(), camera.centers[0].double().numpy()


def vertical_fov(camera: Cameras) -> float:
    """Radians from the top edge to the bottom edge of one camera's image."""
    k, height = camera.intrinsics[0].double(), float(camera.size[0, 1])
    return math.atan(float(k[1, 2] / k[1, 1])) + math.atan(float((height - k[1, 2]) / k[1, 1]))


def aspect(camera: Cameras) -> float:
    """Width over height of one camera's image."""
    return float(camera.size[0, 0]) / float(camera.size[0, 1])
