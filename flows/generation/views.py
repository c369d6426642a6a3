"""Generated views as pictures with cameras: decoded, and cut to the part that shows the scene."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from numpy.typing import NDArray

from cat3d_core.cameras import Cameras
from cat3d_core.generation import Generator
from cat3d_core.sample_sets import source_boxes
from flows.jobs.access import read_cameras
from flows.media.images import square_image, to_uint8
from schemas.scene_store import Run, SceneStore, Section


def captured_sample(store: SceneStore, view: int, kind: str, size: int) -> torch.Tensor:
    """(3, size, size) float32 in [0, 1]: the square sample of a captured view, as it is encoded."""
    image = store.captured.read_image("image", view)
    (box,) = source_boxes(torch.tensor([[image.shape[1], image.shape[0]]]), kind).tolist()
    return torch.from_numpy(square_image(image, box, size)).permute(2, 0, 1).float() / 255


def decoded(generator: Generator, generated: Section, view: int) -> NDArray[np.uint8]:
    """(1, H, W, 3): the image of one sampled view."""
    latent = torch.from_numpy(generated.read("latent", [view]))
    return to_uint8(generator.decode(latent.float()).permute(0, 2, 3, 1))


def in_window(camera: Cameras, image: NDArray[np.uint8], window: list[int]) -> tuple[Cameras, torch.Tensor]:
    """One camera and its (H, W, 3) image, cut to [x0, y0, width, height]: the part of a sample that isn't padding."""
    x0, y0, width, height = window
    part = np.ascontiguousarray(image[y0 : y0 + height, x0 : x0 + width])
    return camera.crop(x0, y0, width, height), torch.from_numpy(part)


def generated_views(run: Run) -> Iterator[tuple[Cameras, torch.Tensor]]:
    """The decoded views that are there: camera and (h, w, 3) uint8 image of the part that isn't padding."""
    shown = np.flatnonzero(run.generated.read("done_image").any(-1)).tolist()
    cameras, windows = read_cameras(run.plan, shown), run.plan.read("window", shown).tolist()
    for i, (view, window) in enumerate(zip(shown, windows, strict=True)):
        yield in_window(cameras[i], run.generated.read("image", [view])[0], window)
