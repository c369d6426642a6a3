"""What is said before a generator's weights are loaded: its terms, and whether memory holds it."""

from __future__ import annotations

import torch

from flows.errors import InputError
from flows.generation.open import generator_spec
from flows.jobs.device import available_memory, device, worker_count
from flows.jobs.job import Job

#: What allocators and kernels take on top of the tensors that are counted (`cat3d_core.diffusion.memory`).
ALLOWANCE = 1.25


def opening(job: Job) -> list[str]:
    """Sentences on the generator's terms, and on what it needs of memory where that is much. Raises InputError for too
    little."""
    spec = generator_spec(job)
    asked, own = job.config.plan.image_size, spec.image_size[0]
    if asked not in (None, own):
        raise InputError(
            f"plan.image_size is {asked}, but the generator makes views of {own} x {own} pixels: leave it out, or make "
            "the planned views with another program (`cat3d export --what plan`, then `cat3d import-views`)."
        )
    out = [spec.terms] if spec.terms else []
    if spec.need is None:
        return out
    settings = job.config.execution
    need = spec.need(settings.groups_at_once, getattr(torch, job.config.sample.precision))
    processes = 1 if device() == "cuda" else worker_count(settings)
    wanted, there = processes * ALLOWANCE * need.total, available_memory()
    each = f"{need.weights / 2**30:.1f} GiB of weights and {need.work / 2**30:.1f} GiB for "
    each += f"{settings.groups_at_once} group{'s' * (settings.groups_at_once > 1)} of {spec.views} views at once"
    of = f"each of {processes} workers" if processes > 1 else "the generator"
    if there is not None and there < wanted:
        raise InputError(
            f"Memory is too small: {of} needs {each}, with allowance {wanted / 2**30:.1f} GiB in all, and "
            f"{there / 2**30:.1f} GiB are free on {device()}. {_remedy(job, processes, spec.at is not None)}"
        )
    return [*out, f"Memory: {of} needs {each}."]


def _remedy(job: Job, processes: int, resizable: bool) -> str:
    """What needs less memory; resizable: the generator also takes smaller windows and images."""
    settings = job.config.execution
    ways = []
    if processes > 1:
        ways.append("execution.workers=1")
    if settings.groups_at_once > 1:
        ways.append("execution.groups_at_once=1")
    if job.config.sample.precision == "float32":
        ways.append("sample.precision=bfloat16")
    if resizable:
        ways.append("a smaller plan.window or plan.image_size")
    ways.append("a device with more memory")
    return f"What helps: {', '.join(ways)}."
