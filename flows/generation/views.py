"""Generated views as pictures with cameras: decoded, and cut to the part that shows the scene."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from cat3d_core.cameras import Cameras
from cat3d_core.generation import Generator
from cat3d_core.sample_sets import source_boxes
from flows.generation.hints import SAMPLE_CONFIDENCE, open_sweep, read_hint
from flows.jobs.access import read_cameras
from flows.jobs.job import Job
from flows.media.images import square_image
from schemas.scene_store import Run, SceneStore, Section


def captured_sample(store: SceneStore, view: int, kind: str, size: int) -> torch.Tensor:
    """(3, size, size) float32 in [0, 1]: the square sample of a captured view, as it is encoded."""
    image = store.captured.read_image("image", view)
    (box,) = source_boxes(torch.tensor([[image.shape[1], image.shape[0]]]), kind).tolist()
    return torch.from_numpy(square_image(image, box, size)).permute(2, 0, 1).float() / 255


def decoded(generator: Generator, generated: Section, view: int) -> torch.Tensor:
    """(H, W, 3) float32 in [0, 1]: the image of one sampled view."""
    latent = torch.from_numpy(generated.read("latent", [view]))
    return generator.decode(latent.float())[0].permute(1, 2, 0)


def finished(
    job: Job, generator: Generator, run: Run, view: int, explained: bool
) -> tuple[torch.Tensor, torch.Tensor | None]:
    """A generated view (H, W, 3) float32 in [0, 1], and with hints the trust in each pixel of it (H, W).

    With hints it is what the photos show where they show the place and the sample elsewhere: a mean of both by the
    confidence of the view's hint. explained: the photos show all of it, and there is no sample.
    """
    if not job.hinted:
        return decoded(generator, run.generated, view), None
    hint = read_hint(run, view)
    colour = hint.colour.float() / 255
    if explained:
        return colour, hint.confidence
    sample, share = decoded(generator, run.generated, view), open_sweep(job).composite.share(hint.confidence)
    trust = SAMPLE_CONFIDENCE + share * (hint.confidence - SAMPLE_CONFIDENCE)
    return sample + share[..., None] * (colour - sample), trust.clamp(0, 1)


def in_window(camera: Cameras, image: NDArray[np.uint8], window: list[int]) -> tuple[Cameras, torch.Tensor]:
    """One camera and its (H, W, 3) image, cut to [x0, y0, width, height]: the part of a sample that isn't padding."""
    x0, y0, width, height = window
    part = np.ascontiguousarray(image[y0 : y0 + height, x0 : x0 + width])
    return camera.crop(x0, y0, width, height), torch.from_numpy(part)


class GeneratedView(NamedTuple):
    """A generated view's part that isn't padding: one camera, (h, w, 3) uint8 image; with hints also the trust in each
    pixel (h, w)."""

    camera: Cameras
    image: torch.Tensor
    trust: torch.Tensor | None = None


def generated_views(run: Run) -> Iterator[GeneratedView]:
    """The generated views that are there."""
    shown = np.flatnonzero(run.generated.read("done_image").any(-1)).tolist()
    cameras, windows = read_cameras(run.plan, shown), run.plan.read("window", shown).tolist()
    hinted = "hints" in run and "confidence" in run.generated
    for i, (view, window) in enumerate(zip(shown, windows, strict=True)):
        camera, image = in_window(cameras[i], run.generated.read("image", [view])[0], window)
        if not hinted:
            yield GeneratedView(camera, image)
            continue
        trust = run.generated.read("confidence", [view])[0].astype(np.float32)
        yield GeneratedView(camera, image, in_window(cameras[i], trust, window)[1])
