"""Stage decode: latents of generated views -> images, fanned out over workers; may be far behind the sampling."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch

from cat3d_core.diffusion import MultiViewModel
from flows.generation.groups import view_keys
from flows.generation.model import model_config, model_hash, shared_model
from flows.jobs.job import Job, Outcome
from flows.jobs.stage import Stage, generates
from flows.media.images import to_uint8
from flows.workers.fan_out import fan_out
from flows.workers.work import Work, is_done
from schemas.decisions import skipped
from schemas.scene_store import SceneStore, Section


def inputs(job: Job, keys: Mapping[str, str]) -> dict[str, Any]:
    """The model's weights."""
    return {"model": model_hash(job)}


def execute(job: Job, store: SceneStore, key: str) -> Outcome:
    """Write `generated/image`, each view recorded in `done_image` when it is complete; only missing ones are made, and
    none of those that were left out of the sampling."""
    generated = store.run(job.run).generated
    views, size = generated.shape("latent")[0], model_config(job).image_size
    generated.create_array("image", (views, size, size, 3))
    generated.create_array("done_image", (views, 32))
    sampled = np.flatnonzero(generated.read("done_latent").any(-1)).tolist()
    left_out = sorted(set(range(views)) - set(sampled))
    generated.mark_skipped("done_image", left_out)
    text = f"Skipped decoding {len(left_out)} of {views} views: they were not sampled."
    decisions = [skipped(text, views=len(left_out))] if left_out else []
    each = [[view] for view in range(views)]
    share = Work(
        job, "decode", key, shared_model, work, generated, "done_image", "image", view_keys(key, views), [sampled], each
    )
    missing = len(share.passes[0])
    label = f"decode {job.scene_id} {job.run}"
    totals = fan_out([share], job.config.execution, label, here=job.config.skip.workers)
    return Outcome({"views": missing, "evaluations": missing} | totals.work(), decisions + totals.decisions)


@torch.no_grad()
def decoded(model: MultiViewModel, generated: Section, view: int) -> np.ndarray:
    """(1, H, W, 3) uint8: the image of one sampled view."""
    latent = torch.from_numpy(generated.read("latent", [view])).float().to(next(model.parameters()).device)
    return to_uint8(model.autoencoder.decode(latent).permute(0, 2, 3, 1))


def work(job: Job, store: SceneStore, key: str, items: Sequence[int]) -> None:
    """A worker's share: decode the views `items`, one at a time."""
    generated = store.run(job.run).generated
    model = shared_model(job)
    keys = view_keys(key, generated.shape("latent")[0])
    for view in items:
        if is_done(generated, "done_image", view, keys[view], "image"):
            continue
        generated.write_views("image", decoded(model, generated, view), [view])
        generated.mark_done("done_image", [keys[view]], [view])


STAGE = Stage("decode", execute, version=1, reads=("sample",), inputs=inputs, wanted=generates)
