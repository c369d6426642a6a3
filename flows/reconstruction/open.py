"""A job's reconstructor, found by its name (`reconstruct.method`).

A package of someone else's brings one through an entry point of the group `cat3d.reconstructors` that names its class.
"""

from __future__ import annotations

import importlib
from importlib.metadata import entry_points
from typing import cast

from cat3d_core.reconstruction import ReconstructionRequest, Reconstructor
from flows.jobs.job import Job
from schemas.config import ReconstructConfig
from schemas.errors import ConfigError

GROUP = "cat3d.reconstructors"
#: Our own, by name: module and class, imported when asked for.
OWN = {"zipnerf": "cat3d_core.zipnerf:ZipNerf", "splats": "cat3d_core.splats:Splats"}


def reconstructor_class(name: str) -> type[Reconstructor]:
    """The reconstructor of this name, ours or an installed package's. Raises ConfigError where there is none."""
    if name in OWN:
        module, _, attribute = OWN[name].partition(":")
        return cast(type[Reconstructor], getattr(importlib.import_module(module), attribute))
    others = {point.name: point for point in entry_points(group=GROUP)}
    if name not in others:
        known = ", ".join([*OWN, *sorted(others)])
        raise ConfigError(f"reconstruct.method: there is no reconstructor {name!r}; installed are {known}.")
    return cast(type[Reconstructor], others[name].load())


def open_reconstructor(job: Job) -> Reconstructor:
    """One for the job, with its settings; nothing of the scene is read. Raises ConfigError naming a bad setting."""
    settings = job.config.reconstruct
    request = ReconstructionRequest(
        settings.preset, settings.overrides, job.dataset, job.generates, job.config.skip.model_dump()
    )
    return _requested(settings.method, request)


def view_pixels(settings: ReconstructConfig) -> int | None:
    """How many pixels of a view the training of a preset can fill, None where the reconstructor does not say. Other
    settings than the preset make no difference, so that to vary them keeps the photos as they are stored."""
    made = _requested(settings.method, ReconstructionRequest(settings.preset))
    return getattr(made, "view_pixels", None)


def _requested(method: str, request: ReconstructionRequest) -> Reconstructor:
    try:
        return reconstructor_class(method).from_request(request)
    except ValueError as error:
        raise ConfigError(f"reconstruct.{error}") from None


def brief_reconstructor(job: Job) -> Reconstructor:
    """The quickest one of the job's method, for captured views alone."""
    kind = reconstructor_class(job.config.reconstruct.method)
    return kind.from_request(ReconstructionRequest(kind.presets[0]))
