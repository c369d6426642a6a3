"""What a brief reconstruction of the captured views knows: enough to choose by, in seconds."""

from __future__ import annotations

import torch
from torch import Tensor

from cat3d_core.cameras import Cameras
from cat3d_core.reconstruction import Reconstructor, Render, Views
from cat3d_core.uncertainty import shown_by
from flows.jobs.device import cpu_threads, exact_device
from flows.jobs.job import Job
from flows.reconstruction.open import brief_reconstructor

#: Captured views that have to show a place: what a single one shows may float anywhere before it.
LEAST = 2
#: Longer side of the pictures of such a reconstruction, in pixels.
SIDE = 64


def brief_reconstruction(job: Job, views: Views) -> Reconstructor:
    """The views, reconstructed as quickly as the job's method does."""
    brief = brief_reconstructor(job)
    with cpu_threads(job.config.execution.threads):
        brief.start(views, job.config.seed, exact_device())
        while not brief.finished:
            brief.step()
    return brief


def brief_render(brief: Reconstructor, cameras: Cameras, view: int) -> Render:
    """What a camera sees of it, at most SIDE pixels on the longer side."""
    return brief.render(cameras, view, min(1.0, SIDE / int(cameras.size[view].max())))


def shown_by_captured(job: Job, views: Views) -> Tensor:
    """(P,) bool, in the order of `views.pixels`: pixels of generated views whose place LEAST captured views show too.

    A brief reconstruction of the captured views alone says where that place is."""
    captured, generated = (torch.nonzero(chosen)[:, 0].tolist() for chosen in (views.captured, ~views.captured))
    known = views.cameras[captured]
    whole = bool((views.counting == views.size.prod(-1))[views.captured].all())
    masks = None if whole or views.valid is None else [views.map(views.valid, v) for v in captured]
    photos = Views.from_images(known, (views.image(v) for v in captured), views.captured[captured], masks)
    brief = brief_reconstruction(job, photos)
    with cpu_threads(job.config.execution.threads):
        depths = [brief_render(brief, known, view).depth.cpu() for view in range(len(captured))]
        found = torch.zeros(len(views.pixels), dtype=torch.bool)
        for view in generated:
            width, height = views.size[view].tolist()
            depth = brief_render(brief, views.cameras, view).depth.cpu()
            count = shown_by(depth, views.cameras[[view]], known, depths)
            count = torch.nn.functional.interpolate(count[None, None].float(), (height, width), mode="nearest-exact")
            first = int(views.offset[view])
            found[first : first + width * height] = count.flatten() >= LEAST
    return found
