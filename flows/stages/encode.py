"""Stage encode: captured views -> latents of their squares at the model's size, once for the scene."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from cat3d_core.sample_sets import KINDS, source_boxes
from flows.generation.groups import CAPTURED_LATENTS
from flows.generation.model import encoder_hash, forget_model, model_config, shared_model
from flows.jobs.device import cpu_threads, device
from flows.jobs.job import Job, Outcome
from flows.jobs.stage import Stage, generates
from flows.media.images import square_image
from flows.progress import Meter, meter
from schemas.content_key import content_key
from schemas.scene_store import SceneStore


def inputs(job: Job, keys: Mapping[str, str]) -> dict[str, Any]:
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


STAGE = Stage("encode", execute, version=1, reads=("poses",), inputs=inputs, wanted=generates, passing=True)
