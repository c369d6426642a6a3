"""Stage encode: captured views -> latents of their squares at the model's size, once for the scene."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from cat3d_core.sample_sets import KINDS, source_boxes
from flows.images import resize
from flows.jobs import Job, Outcome
from flows.progress import Meter, meter
from flows.sampling.groups import CAPTURED_LATENTS
from flows.sampling.model import cpu_threads, device, encoder_hash, forget_model, model_config, shared_model
from schemas.content_key import content_key
from schemas.scene_store import SceneStore

VERSION = 1
#: sRGB grey around images that are padded to squares: the middle of the range the autoencoder knows.
PADDING = 128


def inputs(job: Job) -> dict[str, Any]:
    """The encoder's weights, and which squares are wanted, how large."""
    size = model_config(job).image_size
    return {"model": encoder_hash(job), "image_size": size, "wide": job.config.plan.wide}


def execute(job: Job, store: SceneStore, key: str) -> Outcome:
    """Write `latents/captured` (and `captured_wide`) of all views with a pose: every run of the scene may use them."""
    views = np.flatnonzero(store.captured.read("registered")).tolist()
    kinds = KINDS if job.config.plan.wide else KINDS[:1]
    with meter(f"encode {job.scene_id}", len(views) * len(kinds)) as progress:
        encoded = sum(encode_views(job, store, key, kind, views, progress) for kind in kinds)
    forget_model()  # on a GPU its memory is wanted by the workers, and by the reconstruction
    return Outcome({"views": encoded, "evaluations": encoded})


@torch.no_grad()
def encode_views(job: Job, store: SceneStore, key: str, kind: str, views: list[int], progress: Meter) -> int:
    """Encode those of the views that are missing; how many they were."""
    name = CAPTURED_LATENTS[kind]
    marker = f"done_{name}"
    sizes = torch.from_numpy(store.captured.read("size").astype(np.int64))
    config = model_config(job)
    side = config.unet.latent_size
    store.latents.create_array(name, (len(sizes), config.unet.latent_channels, side, side))
    store.latents.create_array(marker, (len(sizes), 32))
    keys = [content_key(step=key, kind=kind, view=view) for view in range(len(sizes))]
    done = store.latents.done(marker, keys, [name])
    boxes = source_boxes(sizes, kind).tolist()
    missing = [view for view in views if not done[view]]
    progress.advance(len(views) - len(missing))
    with cpu_threads(job.config.execution.threads):
        for view in missing:
            square = square_image(store.captured.read_image("image", view), boxes[view], config.image_size)
            pixels = torch.from_numpy(square).permute(2, 0, 1)[None].float() / 255
            latent = shared_model(job).autoencoder.encode(pixels.to(device()))
            store.latents.write_views(name, latent.half().cpu().numpy(), [view])
            store.latents.mark_done(marker, [keys[view]], [view])
            progress.advance()
    return len(missing)


def square_image(image: np.ndarray, box: Sequence[int], image_size: int) -> np.ndarray:
    """(image_size, image_size, 3) uint8: the square [x0, y0, side] of the image in its pixels, grey beyond it."""
    x0, y0, side = box
    height, width = image.shape[:2]
    square = np.full((side, side, 3), PADDING, np.uint8)
    left, top = max(x0, 0), max(y0, 0)
    part = image[top : min(y0 + side, height), left : min(x0 + side, width)]
    square[top - y0 : top - y0 + part.shape[0], left - x0 : left - x0 + part.shape[1]] = part
    return resize(square, image_size, image_size)
