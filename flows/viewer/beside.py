"""What one camera saw, what was generated for it and what the reconstruction shows from there, side by side."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cat3d_core.splines import rotation_angle
from flows.media.images import resize
from flows.reporting.content import ShownView
from flows.viewer.keyframes import TURN

SIDE = 320
"""Longer side in pixels of a picture beside others: what the panel has room for."""
KINDS = {"photo": ("train", "test"), "generated": ("generated",)}


def companions(view: ShownView, views: Sequence[ShownView]) -> list[tuple[str, np.ndarray]]:
    """(caption, picture) of the photo and the generated view that belong to a camera: its own, or else those of the
    nearest camera, which the caption names. None of a kind that the run has none of."""
    found = []
    for title, kinds in KINDS.items():
        pictured = [other for other in views if other.kind in kinds and other.image is not None]
        if pictured:
            nearest = min(pictured, key=lambda other: apart(view, other))
            own = nearest.kind == view.kind and nearest.index == view.index
            caption = title if own else f"{title}, nearest: {nearest.name}"
            assert nearest.image is not None
            found.append((caption, nearest.image))
    return found


def apart(a: ShownView, b: ShownView) -> float:
    """Scene units between two cameras, of which a turn of TURN radians counts as one."""
    moved = float((a.camera.centers[0] - b.camera.centers[0]).norm())
    turned = float(rotation_angle(a.camera.rotation.double(), b.camera.rotation.double())[0])
    return moved + turned / TURN


def side_by_side(pictures: Sequence[np.ndarray], least: int = 128) -> np.ndarray:
    """Pictures (h, w, 3) uint8, at the height of the highest and at least so many pixels, beside each other with a
    white line between."""
    height = max(least, *(picture.shape[0] for picture in pictures))
    parts: list[np.ndarray] = []
    for picture in pictures:
        scale = height / picture.shape[0]
        parts.append(resize(picture, max(1, round(picture.shape[1] * scale)), height))
        parts.append(np.full((height, 2, 3), 255, np.uint8))
    return np.concatenate(parts[:-1], 1)
