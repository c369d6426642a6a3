"""Stage reconstruct: captured (and generated) views -> one reconstruction, checkpointed while it trains."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from typing import Any

from cat3d_core.reconstruction import Reconstructor
from flows.generation.hints import sweep_identity
from flows.jobs.device import exact_device
from flows.jobs.job import Job, Outcome
from flows.jobs.needs import Needs
from flows.jobs.stage import Stage, settings_of
from flows.progress import meter
from flows.reconstruction.open import open_reconstructor
from flows.reconstruction.stored import Checkpoint, write_reconstruction
from flows.stages.training_views import enough, training_views
from schemas.decisions import Decision, skipped
from schemas.scene_store import SceneStore

#: A row of the training record at every so many steps.
RECORD_EVERY = 10


def inputs(job: Job, keys: Mapping[str, str]) -> dict[str, Any]:
    """The training views, the reconstructor's settings in full, and what decides which pixels are trained on: a changed
    preset or rule makes old fields stale."""
    skip = job.config.skip
    train = job.view_names("train")
    bound = enough(len(train)) if skip.seen and job.generates else None
    found: dict[str, Any] = {"train": train, "detail": skip.detail, "seen": bound or skip.seen}
    if job.generates and skip.seen and job.capture().mask_training:
        found["masks"] = True  # the brief field heeds them
    if job.hinted:
        found["depths"] = sweep_identity(job)
    return found | dict(open_reconstructor(job).settings)


def execute(job: Job, store: SceneStore, key: str) -> Outcome:
    """Reconstruct, write `field/` (tensors, settings, training record); goes on from its checkpoint if it was
    stopped."""
    run = store.run(job.run)
    reconstructor = open_reconstructor(job)
    views, decisions = training_views(job, store, run)
    started = reconstructor.start(views, job.config.seed, exact_device())
    decisions += [Decision(**vars(decision)) for decision in started]
    checkpoint = Checkpoint(job, key)
    state = checkpoint.load()
    if state is not None:
        reconstructor.load_state(state)
    first = reconstructor.iteration
    if first:
        decisions.append(skipped(f"Went on from the checkpoint at iteration {first}.", steps=first))
    pause = job.config.execution.checkpoint_s
    record, rays = _train(reconstructor, checkpoint, pause, f"reconstruct {job.scene_id} {job.run}")
    decisions += [Decision(**vars(decision)) for decision in reconstructor.decisions()]
    write_reconstruction(run, job.config.reconstruct.method, reconstructor, record)
    checkpoint.remove()
    return Outcome({"views": len(views), "steps": reconstructor.iteration - first, "rays": rays}, decisions)


def _train(
    reconstructor: Reconstructor, checkpoint: Checkpoint, pause: float, title: str
) -> tuple[list[list[float]], float]:
    """All steps that are left, saved every `pause` seconds; the rows of the training record, and the rays cast."""
    record, rays = [], 0.0
    saved = started = time.monotonic()
    with meter(title, reconstructor.iterations) as progress:
        while not reconstructor.finished:
            step = reconstructor.step()
            rays += step.get("rays", 0.0)
            loss, psnr = step.get("loss", math.nan), step.get("psnr", math.nan)
            if reconstructor.iteration % RECORD_EVERY == 0 or reconstructor.finished:
                record.append([reconstructor.iteration, time.monotonic() - started, loss, psnr])
            progress.update(reconstructor.iteration, f"{psnr:.1f} dB" if "psnr" in step else "")
            if time.monotonic() - saved > pause:
                checkpoint.save(reconstructor.state())
                saved = time.monotonic()
    return record, rays


STAGE = Stage(
    "reconstruct",
    execute,
    version=5,
    reads=("poses", "decode"),
    settings=settings_of("reconstruct", "seed", unless={"method": "zipnerf"}),
    inputs=inputs,
    needs=Needs(gpu=True, memory_gb=2.0),
)
