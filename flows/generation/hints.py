"""What the photos show of planned views: the plane sweep of a job, and its results as the store holds them."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from cat3d_core.matching.checkpoint import describe_sweep, load_sweep
from cat3d_core.matching.network import SweepNetwork
from cat3d_core.weights import default_sweep_path
from flows.errors import InputError
from flows.jobs.device import device
from flows.jobs.job import Job
from schemas.content_key import content_key
from schemas.scene_store import Run

#: A view is explained where all but this share of its pixels are the photos' own by at least `OWN`.
UNEXPLAINED_SHARE, OWN = 0.005, 0.9
#: Trust in a pixel that the diffusion model alone made, beside the confidence of what photos show: its error is about
#: that of a hint of this confidence.
SAMPLE_CONFIDENCE = 0.35


class StoredHint(NamedTuple):
    """One view's hint as stored: colour (H, W, 3) uint8; confidence, inverse_depth, spread, seen (H, W) float32."""

    colour: torch.Tensor
    confidence: torch.Tensor
    inverse_depth: torch.Tensor
    spread: torch.Tensor
    seen: torch.Tensor


def sweep_identity(job: Job) -> str:
    """The hash of the job's plane sweep: its weights, and how it blends. Raises InputError for a file that is none."""
    path = _path(job)
    return _identity(path, path.stat().st_mtime_ns)


def open_sweep(job: Job) -> SweepNetwork:
    """The job's plane sweep on this process's device, loaded once. Raises InputError for a file that is none."""
    path = _path(job)
    return _loaded(path, path.stat().st_mtime_ns, device())


def read_hint(run: Run, view: int) -> StoredHint:
    """The stored hint of a planned view."""
    section = run.section("hints")
    maps = (torch.from_numpy(section.read(name, [view])[0].astype(np.float32)) for name in StoredHint._fields[1:])
    return StoredHint(torch.from_numpy(section.read("colour", [view])[0]), *maps)


def explained_views(job: Job, run: Run) -> np.ndarray:
    """(N,) bool: the planned views that the photos show wholly; none where the job uses no hints (those of an earlier
    run may still lie there)."""
    if not job.hinted or "hints" not in run:
        return np.zeros(run.plan.shape("size")[0], bool)
    return run.section("hints").read("explained")


def _path(job: Job) -> Path:
    path = job.config.hints.checkpoint
    if path is None:
        try:
            return default_sweep_path()
        except FileNotFoundError as error:
            raise InputError(str(error)) from None
    if not path.is_file():
        raise InputError(f"hints.checkpoint: there is no file {path}.")
    return path.resolve()


@functools.lru_cache(maxsize=4)
def _identity(path: Path, _changed: int) -> str:
    try:
        known = describe_sweep(path)
        return content_key(**{name: known[name] for name in ("sha256", "config", "composite")})
    except ValueError as error:
        raise InputError(f"hints.checkpoint: {error}") from None


@functools.lru_cache(maxsize=1)
def _loaded(path: Path, _changed: int, where: str) -> SweepNetwork:
    try:
        return load_sweep(path, where)
    except ValueError as error:
        raise InputError(f"hints.checkpoint: {error}") from None
