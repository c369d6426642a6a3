"""Small scenes written to disk in each foreign layout from cameras that are known."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from cat3d_core.cameras import Cameras
from flows.media.images import write_png

WIDTH, HEIGHT = 64, 48


def _cameras(count: int) -> Cameras:
    poses = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    for i in range(count):
        angle = 0.15 * (i - count / 2)
        c, s = math.cos(angle), math.sin(angle)
        a, b = math.cos(0.1 * i), math.sin(0.1 * i)
        tilt = torch.tensor([[1, 0, 0], [0, a, -b], [0, b, a]], dtype=torch.float64)
        poses[i, :3, :3] = torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]], dtype=torch.float64) @ tilt
        poses[i, :3, 3] = torch.tensor([0.3 * i, 0.1 * i * i, -0.2 * i], dtype=torch.float64)
    k = torch.tensor([[70.0, 0, 33.0], [0, 71.0, 23.0], [0, 0, 1]], dtype=torch.float64).repeat(count, 1, 1)
    return Cameras(k, poses, torch.tensor([[WIDTH, HEIGHT]]).repeat(count, 1))


@pytest.fixture
def truth() -> Cameras:
    """Ten known cameras, 64 x 48 pixels, OpenCV axes."""
    return _cameras(10)


@pytest.fixture
def points() -> torch.Tensor:
    """(20, 3) points in front of all of them."""
    generator = torch.Generator().manual_seed(0)
    return torch.rand(20, 3, generator=generator, dtype=torch.float64) * 2 + torch.tensor([0.0, 0, 6.0])


@pytest.fixture
def write_images():
    """Write `count` images to folder/prefixNNN.png and return their names."""

    def write(
        folder: Path, count: int, width: int = WIDTH, height: int = HEIGHT, names: list[str] | None = None
    ) -> list[str]:
        folder.mkdir(parents=True, exist_ok=True)
        names = names or [f"{i:03d}.png" for i in range(count)]
        for i, name in enumerate(names):
            write_png(folder / name, np.full((height, width, 3), 10 * i, np.uint8))
        return names

    return write
