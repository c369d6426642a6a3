"""What a field trained briefly on the captured views knows: enough to choose by, in seconds."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from cat3d_core.cameras import Cameras
from cat3d_core.uncertainty import shown_by
from cat3d_core.zipnerf import PRESETS, Field, Trainer, Views, render_image
from cat3d_core.zipnerf.render import Render
from flows.generation.model import cpu_threads, device

#: Captured views that have to show a place: what a single one shows may float anywhere before it.
LEAST = 2
#: Longer side of the pictures of such a field, in pixels.
SIDE = 64


def brief_field(views: Views, seed: int, threads: int) -> Field:
    """A field trained with the smallest preset."""
    config = replace(PRESETS["tiny"], lpips_weight=0.0)
    with cpu_threads(threads):
        trainer = Trainer(config, views, seed, device())
        while not trainer.finished:
            trainer.step()
    return trainer.field


def brief_render(field: Field, cameras: Cameras, view: int) -> Render:
    """What a camera sees of a field, at most SIDE pixels on the longer side."""
    return render_image(field, cameras, view, resolution_scale=min(1.0, SIDE / int(cameras.size[view].max())))


def shown_by_captured(views: Views, seed: int, threads: int) -> Tensor:
    """(P,) bool, in the order of `views.pixels`: pixels of generated views whose place LEAST captured views show too.

    Where that place is says a field trained briefly on the captured views."""
    captured, generated = (torch.nonzero(chosen)[:, 0].tolist() for chosen in (views.captured, ~views.captured))
    known = views.cameras[captured]
    field = brief_field(Views(known, [views.image(v) for v in captured], views.captured[captured]), seed, threads)
    with cpu_threads(threads):
        depths = [brief_render(field, known, view).depth.cpu() for view in range(len(captured))]
        found = torch.zeros(len(views.pixels), dtype=torch.bool)
        for view in generated:
            width, height = views.size[view].tolist()
            depth = brief_render(field, views.cameras, view).depth.cpu()
            count = shown_by(depth, views.cameras[[view]], known, depths)
            count = torch.nn.functional.interpolate(count[None, None].float(), (height, width), mode="nearest-exact")
            first = int(views.offset[view])
            found[first : first + width * height] = count.flatten() >= LEAST
    return found
