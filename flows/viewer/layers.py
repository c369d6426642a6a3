"""What a browser's scene is made of: frusta with pictures, the plan's path, points and splats."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import viser

from cat3d_core.splats import Gaussians
from flows.media.images import resize
from flows.reporting.content import ShownView
from flows.viewer.cameras import aspect, place, vertical_fov

THUMBNAIL = 96
"""Longer side in pixels of a frustum's picture."""
ENLARGED = 30.0
"""Splats travel this much larger: their variances are half precision numbers, between 6e-8 and 6.5e4."""
MOST_VARIANCE = 6e4
COLOURS = {"train": (214, 39, 40), "test": (31, 119, 180)}
"""As in the drawing of the plan: captured red; held-out views blue."""
ANCHOR = (255, 127, 14)
GROUPS = {"train": "captured", "test": "held out", "generated": "generated", "planned": "planned"}


def plan_colour(share: float) -> tuple[int, int, int]:
    """Of a planned view at this share of the plan: from dark violet to yellow, as in the drawing."""
    from matplotlib import colormaps

    red, green, blue = (int(255 * part + 0.5) for part in colormaps["viridis"](share)[:3])
    return red, green, blue


def add_view(scene: viser.SceneApi, view: ShownView, size: float, on_click: Callable[[ShownView], Any]) -> Any:
    """A frustum of `size` scene units with the view's picture; a click on it calls `on_click`."""
    wxyz, position = place(view.camera)
    colour = ANCHOR if view.anchor else COLOURS.get(view.kind) or plan_colour(view.share)
    handle = scene.add_camera_frustum(
        f"/{GROUPS[view.kind]}/{view.index}", vertical_fov(view.camera), aspect(view.camera), scale=size, color=colour,
        image=None if view.image is None else thumbnail(view.image), wxyz=wxyz, position=position,
        thickness=size / 60, cast_shadow=False, receive_shadow=False,
    )  # fmt: skip
    handle.on_click(lambda _: on_click(view))
    return handle


def thumbnail(image: np.ndarray, side: int = THUMBNAIL) -> np.ndarray:
    """The picture with its longer side at most so many pixels."""
    height, width = image.shape[:2]
    shrink = min(1.0, side / max(height, width))
    return resize(image, max(1, round(width * shrink)), max(1, round(height * shrink)))


def add_path(scene: viser.SceneApi, views: Sequence[ShownView]) -> Any:
    """The plan as a line through its views, coloured by their place on it; None for fewer than two."""
    if len(views) < 2:
        return None
    centres = np.stack([place(view.camera)[1] for view in views]).astype(np.float32)
    colours = np.array([plan_colour(view.share) for view in views], np.uint8)
    pairs = np.stack([centres[:-1], centres[1:]], 1)
    return scene.add_line_segments("/path", pairs, np.stack([colours[:-1], colours[1:]], 1), thickness=0.004)


def add_points(scene: viser.SceneApi, points: np.ndarray) -> Any:
    """The scene's sparse points, grey; None where there are none."""
    if not len(points):
        return None
    return scene.add_point_cloud("/points", points, (150, 150, 150), point_size=0.004)


def add_splats(scene: viser.SceneApi, splats: Gaussians, visible: bool) -> Any:
    """Splats of the scene frame; the browser draws colours that are the same from all sides."""
    covariances = splats.covariances.double() * ENLARGED**2
    largest = covariances.diagonal(dim1=1, dim2=2).amax(1)[:, None, None]
    covariances = covariances * (MOST_VARIANCE / largest).clamp_max(1.0)
    colours = splats.colours(splats.means.new_zeros(3)).clamp(0, 1)
    return scene.add_gaussian_splats(
        "/splats", splats.means.double().numpy() * ENLARGED, covariances.numpy(), colours.numpy(),
        splats.opacities[:, None].numpy(), scale=1 / ENLARGED, visible=visible,
    )  # fmt: skip
