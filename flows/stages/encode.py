"""Stage encode: captured views -> latents of their squares at the model's size, once for the scene."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from cat3d_core.sample_sets import KINDS
from flows.generation.groups import CAPTURED_LATENTS
from flows.generation.imported import samples
from flows.generation.open import forget_generator, generator_spec, open_generator
from flows.generation.views import captured_sample
from flows.jobs.device import cpu_threads
from flows.jobs.job import Job, Outcome
from flows.jobs.needs import Needs
from flows.jobs.stage import Stage
from flows.progress import Meter, meter
from schemas.content_key import content_key
from schemas.scene_store import SceneStore


def inputs(job: Job, keys: Mapping[str, str]) -> dict[str, Any]:
    """The generator's encoder, and which squares are wanted, how large."""
    spec = generator_spec(job)
    return {"model": spec.encoder_identity, "image_size": spec.image_size[0], "wide": job.config.plan.wide}


def execute(job: Job, store: SceneStore, key: str) -> Outcome:
    """Write `latents/captured` (and `captured_wide`) of all views with a pose: every run of the scene may use them."""
    views = np.flatnonzero(store.captured.read("registered")).tolist()
    kinds = KINDS if job.config.plan.wide else KINDS[:1]
    with meter(f"encode {job.scene_id}", len(views) * len(kinds)) as progress:
        encoded = sum(encode_views(job, store, key, kind, views, progress) for kind in kinds)
    forget_generator()  # on a GPU its memory is wanted by the workers, and by the reconstruction
    return Outcome({"views": encoded, "evaluations": encoded})


def encode_views(job: Job, store: SceneStore, key: str, kind: str, views: list[int], progress: Meter) -> int:
    """Encode those of the views that are missing; how many they were."""
    name = CAPTURED_LATENTS[kind]
    marker = f"done_{name}"
    count = store.captured.shape("size")[0]
    spec = generator_spec(job)
    store.latents.create_array(name, (count, *spec.latent_shape))
    store.latents.create_array(marker, (count, 32))
    keys = [content_key(step=key, kind=kind, view=view) for view in range(count)]
    done = store.latents.done(marker, keys, [name])
    missing = [view for view in views if not done[view]]
    progress.advance(len(views) - len(missing))
    with cpu_threads(job.config.execution.threads):
        for view in missing:
            latent = open_generator(job).encode(captured_sample(store, view, kind, spec.image_size[0])[None])
            store.latents.write_views(name, latent.half().numpy(), [view])
            store.latents.mark_done(marker, [keys[view]], [view])
            progress.advance()
    return len(missing)


STAGE = Stage(
    "encode",
    execute,
    version=1,
    reads=("poses",),
    inputs=inputs,
    wanted=samples,
    passing=True,
    needs=Needs(gpu=True, memory_gb=1.0),
)
