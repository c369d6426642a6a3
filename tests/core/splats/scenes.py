"""Small random scenes of Gaussians and a camera on them, shared by the tests."""

from __future__ import annotations

import torch
from torch import Tensor

from cat3d_core.cameras import Cameras
from cat3d_core.quaternions import rotation_matrices
from cat3d_core.splats.gaussians import Gaussians


def camera(width: int = 45, height: int = 37) -> Cameras:
    """A tilted camera two units away, with skew and its centre beside the middle."""
    k = [[1.0 * width, 0.7, 0.5 * width + 1.3], [0.0, 1.1 * width, 0.5 * height - 0.7], [0.0, 0.0, 1.0]]
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = rotation_matrices(torch.tensor([1.0, 0.1, -0.05, 0.08], dtype=torch.float64))
    pose[2, 3] = -2.0
    return Cameras(torch.tensor([k], dtype=torch.float64), pose[None], torch.tensor([[width, height]]))


def gaussians(count: int, seed: int = 0, degree: int = 0) -> Gaussians:
    """Gaussians of all shapes around the origin, float64, some of them behind the camera or beside its image."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator, dtype=torch.float64)

    return Gaussians(
        0.7 * normal(count, 3), normal(count, 4), normal(count, 3) - 3.0, 2.0 * normal(count),
        normal(count, (degree + 1) ** 2, 3),
    )  # fmt: skip
