"""Pictures of numbers: depth and error as colours."""

from __future__ import annotations

import numpy as np


def depth_picture(depth: np.ndarray, near: float | None = None, far: float | None = None) -> np.ndarray:
    """(H, W, 3) uint8 of z-depth (H, W): inverse depth through a perceptually even colour map, near bright.

    near, far: the range in the depth's unit; by default the 1 % and 95 % quantiles of the positive depths.
    """
    from matplotlib import colormaps

    inside = depth[np.isfinite(depth) & (depth > 0)]
    if not inside.size:
        return np.zeros((*depth.shape, 3), np.uint8)
    low, high = np.quantile(inside, [0.01, 0.95])
    near, far = near or float(low), far or float(high)
    inverse = 1 / np.clip(np.nan_to_num(depth, nan=far, posinf=far), near, max(far, near * 1.001))
    share = (inverse - 1 / max(far, near * 1.001)) / max(1 / near - 1 / max(far, near * 1.001), 1e-12)
    return (colormaps["turbo"](share)[..., :3] * 255 + 0.5).astype(np.uint8)


def share_picture(values: np.ndarray) -> np.ndarray:
    """(H, W, 3) uint8 of values (H, W) from 0, dark, to 1 or the largest where that is more, bright."""
    from matplotlib import colormaps

    finite = np.nan_to_num(values.astype(np.float32), nan=0.0, posinf=0.0, neginf=0.0)
    return (colormaps["viridis"](np.clip(finite / max(1.0, float(finite.max())), 0, 1))[..., :3] * 255 + 0.5).astype(
        np.uint8
    )


def error_picture(image: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """(H, W, 3) uint8: the mean absolute difference over channels, black at 0, white at a quarter of the range."""
    from matplotlib import colormaps

    error = np.abs(image.astype(np.float32) - truth.astype(np.float32)).mean(-1) / 255
    return (colormaps["inferno"](np.clip(error * 4, 0, 1))[..., :3] * 255 + 0.5).astype(np.uint8)
