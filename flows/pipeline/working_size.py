"""The size at which photos are worked on, where none is asked for: what the training can fill and the memory holds."""

from __future__ import annotations

import math
from collections.abc import Sequence

from flows.jobs.device import device, total_memory
from flows.jobs.job import Job
from flows.reconstruction.open import view_pixels

#: Photos of up to so many pixels stay as they are with every preset; larger ones are not made smaller than this by one.
LEAST_PIXELS = 2**17
#: A photo that has up to so many times as many pixels as are wanted stays as it is.
TOLERATED = 1.5
#: Bytes that training takes for a pixel of a photo, and the share of the device's memory that photos may take.
PIXEL_BYTES, MEMORY_SHARE = 8, 0.25


def with_working_size(jobs: Sequence[Job]) -> list[Job]:
    """Jobs of one scene, those that leave the size open with one for all of them, since they share its store: the
    finest that one of their presets can fill. Raises ConfigError for a preset or method that there isn't."""
    open_ = [job for job in jobs if job.config.ingest.downscale is None]
    if not open_:
        return list(jobs)
    capture = jobs[0].capture()
    width, height = max((capture.size(view) for view in range(len(capture))), key=math.prod)
    presets = {job.config.reconstruct.preset: view_pixels(job.config.reconstruct) for job in open_}
    preset = max(presets, key=lambda name: presets[name] or 0)
    fills, holds = max(presets[preset] or 0, LEAST_PIXELS), held(len(capture))
    scale, text = 1.0, ""
    if width * height > TOLERATED * min(fills, holds):
        scale = math.ceil(10 * math.sqrt(width * height / min(fills, holds))) / 10
        why = f"about as much as the training of the preset {preset} can fill"
        if holds < fills:
            why = f"about as much as {len(capture)} of them may take of the memory of this machine's {device()}"
        text = (
            f"Photos of {width} x {height} pixels are worked on at {round(width / scale)} x {round(height / scale)}: "
            f"{why}. --downscale takes another size: {scale:g} is this one, 1 the whole."
        )
    return [_sized(job, scale, text) if job in open_ else job for job in jobs]


def held(views: int) -> float:
    """Pixels that each of so many photos may have. The memory counts as the next lower power of two, so that machines
    of a kind and restarts agree."""
    memory = total_memory()
    if memory is None:
        return math.inf
    return 2 ** math.floor(math.log2(memory)) * MEMORY_SHARE / PIXEL_BYTES / views


def _sized(job: Job, scale: float, text: str) -> Job:
    ingest = job.config.ingest.model_copy(update={"downscale": scale})
    return job.model_copy(update={"config": job.config.model_copy(update={"ingest": ingest}), "working_size": text})
