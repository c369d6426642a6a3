"""Real images for the metric tests, and a float64 SSIM written from its definition."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor


def read(path: Path, size: tuple[int, int] | None = None) -> Tensor:
    """(3, H, W) float32 in [0, 1]; `size` (width, height) resizes."""
    image = Image.open(path).convert("RGB")
    image = image.resize(size) if size else image
    return torch.from_numpy(np.array(image)).permute(2, 0, 1).float() / 255


@pytest.fixture(scope="session")
def real_pairs(shared_data: Path) -> tuple[Tensor, Tensor]:
    """Two batches (3, 3, 378, 504): neighbouring photographs of two scenes, and a photograph with noise."""
    fern, flower = (shared_data / f"llff_{name}" / "images_8" for name in ("fern", "flower"))
    files = [sorted(folder.glob("*.webp"))[:2] for folder in (fern, flower)]
    a, b = torch.stack([read(f[0]) for f in files]), torch.stack([read(f[1]) for f in files])
    noise = torch.randn(a[:1].shape, generator=torch.Generator().manual_seed(0)) * 0.03
    return torch.cat([(a[:1] + noise).clamp(0, 1), a]), torch.cat([a[:1], b])


@pytest.fixture(scope="session")
def masked_pair(shared_data: Path) -> tuple[Tensor, Tensor, Tensor]:
    """A DTU photograph, its neighbour and its mask, at 400x300: (3, H, W), (3, H, W), (H, W) bool."""
    folder = shared_data / "dtu_scan24"
    a, b = (read(p, (400, 300)) for p in sorted((folder / "image").iterdir())[:2])
    mask = np.array(Image.open(sorted((folder / "mask").iterdir())[0]).convert("L").resize((400, 300), Image.NEAREST))
    return a, b, torch.from_numpy(mask > 127)


def ssim_float64(
    x: np.ndarray, y: np.ndarray, kernel: np.ndarray, pad: int = 0, sample: bool = False, data_range: float = 1.0
) -> float:
    """SSIM of two (H, W, C) images with a 2D `kernel`, from the definition (covariances clipped as dm_pix does)."""
    x, y = (np.pad(i.astype(np.float64), ((pad, pad), (pad, pad), (0, 0))) for i in (x, y))
    size = len(kernel)

    def mean(image: np.ndarray) -> np.ndarray:
        windows = np.lib.stride_tricks.sliding_window_view(image, (size, size), axis=(0, 1))
        return np.einsum("hwcij,ij->hwc", windows, kernel)

    mx, my = mean(x), mean(y)
    norm = size * size / (size * size - 1) if sample else 1.0
    floor = np.finfo(np.float32).eps ** 2
    vx, vy = (np.maximum(floor, norm * (mean(i * i) - m * m)) for i, m in ((x, mx), (y, my)))
    cov = norm * (mean(x * y) - mx * my)
    cov = np.sign(cov) * np.minimum(np.sqrt(vx * vy), np.abs(cov))
    c1, c2 = (0.01 * data_range) ** 2, (0.03 * data_range) ** 2
    local = (2 * mx * my + c1) * (2 * cov + c2) / ((mx * mx + my * my + c1) * (vx + vy + c2))
    return float(local.mean())


def gaussian_kernel() -> np.ndarray:
    line = np.exp(-0.5 * ((np.arange(11) - 5) / 1.5) ** 2)
    line /= line.sum()
    return np.outer(line, line)


def to_numpy(image: Tensor) -> np.ndarray:
    """(3, H, W) tensor to (H, W, 3) float64."""
    return image.permute(1, 2, 0).double().numpy()


@pytest.fixture(scope="session")
def reference():
    """The references above, as a name space (test folders aren't packages)."""
    from types import SimpleNamespace

    return SimpleNamespace(ssim=ssim_float64, gaussian=gaussian_kernel(), box=np.full((7, 7), 1 / 49), numpy=to_numpy)
