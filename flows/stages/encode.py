"""Stage encode: captured views -> latents of their squares at the model's size, once for the scene."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from cat3d_core.sample_sets import KINDS, source_boxes
from flows.images import resize
from flows.jobs import Job, Outcome
from flows.progress import meter
from flows.sampling.groups import CAPTURED_LATENTS
from flows.sampling.model import model_config, model_hash, shared_model
from schemas.content_key import content_key
from schemas.scene_store import SceneStore

VERSION = 1
#: sRGB grey around images that are padded to squares: the middle of the range the autoencoder knows.
PADDING = 128


def inputs(job: Job) -> dict[str, Any]:
    """The model's weights, and which squares are wanted."""
    return {"model": model_hash(job), "wide": job.config.plan.wide}


def execute(job: Job, store: SceneStore, key: str) -> Outcome:
    """Write `latents/captured` (and `captured_wide`) of all views with a pose: every run of the scene may use them."""
    torch.set_num_threads(job.config.execution.threads)
    model, config = shared_model(job), model_config(job)
    unet = config.unet
    views = np.flatnonzero(store.captured.read("registered")).tolist()
    kinds = KINDS if job.config.plan.wide else KINDS[:1]
    sizes = torch.from_numpy(store.captured.read("size").astype(np.int64))
    encoded = 0
    with meter(f"encode {job.scene_id}", len(views) * len(kinds)) as progress:
        for kind in kinds:
            name = CAPTURED_LATENTS[kind]
            marker = f"done_{name}"
            store.latents.create_array(name, (len(sizes), unet.latent_channels, unet.latent_size, unet.latent_size))
            store.latents.create_array(marker, (len(sizes), 32))
            keys = [content_key(step=key, kind=kind, view=view) for view in range(len(sizes))]
            done = store.latents.done(marker, keys, [name])
            boxes = source_boxes(sizes, kind).tolist()
            for view in views:
                if not done[view]:
                    square = square_image(store.captured.read_image("image", view), boxes[view], config.image_size)
                    pixels = torch.from_numpy(square).permute(2, 0, 1)[None].float() / 255
                    latent = model.autoencoder.encode(pixels.to(next(model.parameters()).device))
                    store.latents.write_views(name, latent.half().cpu().numpy(), [view])
                    store.latents.mark_done(marker, [keys[view]], [view])
                    encoded += 1
                progress.advance()
    return Outcome({"views": encoded, "evaluations": encoded})


def square_image(image: np.ndarray, box: Sequence[int], image_size: int) -> np.ndarray:
    """(image_size, image_size, 3) uint8: the square [x0, y0, side] in pixels of the image, grey where it goes beyond."""
    x0, y0, side = box
    height, width = image.shape[:2]
    square = np.full((side, side, 3), PADDING, np.uint8)
    left, top = max(x0, 0), max(y0, 0)
    part = image[top : min(y0 + side, height), left : min(x0 + side, width)]
    square[top - y0 : top - y0 + part.shape[0], left - x0 : left - x0 + part.shape[1]] = part
    return resize(square, image_size, image_size)
