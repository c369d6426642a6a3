"""The multi-view model a job samples with: which file, what it is, and one copy of it in each process."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

import torch

from cat3d_core.diffusion import GuidanceConfig, MultiViewModel, SamplerConfig, describe, load_model
from cat3d_core.diffusion.config import ModelConfig, from_dict
from cat3d_core.weights import default_model_path
from flows.errors import InputError
from flows.jobs.device import device, free_device_memory
from flows.jobs.job import Job

#: On the front of `cat3d bench sampler`: the fewest steps whose error, on problems with a known answer, is within that
#: of the paper's sampler.
SAMPLER_DEFAULT: dict[str, Any] = {"solver": "unipc", "nodes": "log_snr", "steps": 10, "guidance": 3.0}
PAPER_SAMPLER: dict[str, Any] = {"solver": "ddim", "nodes": "trailing", "steps": 50, "guidance": 3.0}
#: Lowest and highest log-SNR of guidance: above 2 it changed nothing there.
GUIDANCE_INTERVAL = (None, 2.0)


def checkpoint_path(job: Job) -> Path:
    """The model file of the job. Raises InputError where there is none."""
    given = job.config.sample.checkpoint
    try:
        path = given or default_model_path()
    except FileNotFoundError as error:
        raise InputError(f"{error} The setting for that is sample.checkpoint.") from None
    if not path.is_file():
        raise InputError(f"sample.checkpoint: there is no model file {path}.")
    return path.resolve()


def model_config(job: Job) -> ModelConfig:
    """The model's configuration, read without its weights. Raises InputError for a file that is no model."""
    return from_dict(ModelConfig, _description(job)["config"])


def model_hash(job: Job) -> str:
    """SHA-256 of the model's weights, as recorded in its file."""
    return str(_description(job)["sha256"])


def encoder_hash(job: Job) -> str:
    """SHA-256 of the weights that make latents: a model whose U-Net alone was trained further needs no new ones."""
    return str(_description(job)["encoder_sha256"])


def _description(job: Job) -> dict[str, Any]:
    path = checkpoint_path(job)
    return _described(path, path.stat().st_mtime_ns)


@functools.lru_cache(maxsize=4)
def _described(path: Path, _changed: int) -> dict[str, Any]:
    try:
        return describe(path)
    except ValueError as error:
        raise InputError(f"sample.checkpoint: {error}") from None


def shared_model(job: Job) -> MultiViewModel:
    """The job's model on this process's device; loaded and checked against its hash once a process."""
    path = checkpoint_path(job)
    return _loaded(path, path.stat().st_mtime_ns, device(), job.config.sample.precision)


@functools.lru_cache(maxsize=1)
def _loaded(path: Path, _changed: int, where: str, precision: str) -> MultiViewModel:
    try:
        model = load_model(path, where)
    except ValueError as error:
        raise InputError(f"sample.checkpoint: {error}") from None
    model.unet.to(getattr(torch, precision))  # the autoencoder stays in float32
    return model


def forget_model() -> None:
    """Free the memory of this process's model."""
    _loaded.cache_clear()
    free_device_memory()


def sampler_settings(job: Job) -> dict[str, Any]:
    """How the job samples: solver, nodes, steps, guidance (the run's own where given, else the model's, else the
    measured default), the interval of guidance, and whether groups near captured views take fewer steps. Without
    `skip.solver` solver, nodes and steps are the paper's; guidance, which is no skip, stays the model's."""
    settings, skip = job.config.sample, job.config.skip
    advice = _description(job)["provenance"].get("sampler", {})
    if skip.solver:
        recommended = SAMPLER_DEFAULT | advice
    else:
        recommended = PAPER_SAMPLER | {name: value for name, value in advice.items() if name == "guidance"}
    own = {name: getattr(settings, name) for name in recommended}
    chosen = {name: recommended[name] if value is None else value for name, value in own.items()}
    limited = skip.guidance and chosen["guidance"] != 1
    interval = settings.guidance_log_snr or GUIDANCE_INTERVAL if limited else (None, None)
    return chosen | {"guidance_log_snr": list(interval), "near_steps": skip.near_steps}


def sampler_config(job: Job) -> SamplerConfig:
    """The core's settings of the sampler for the run's."""
    chosen = sampler_settings(job)
    low, high = chosen["guidance_log_snr"]
    guidance = GuidanceConfig(
        chosen["guidance"],
        low_log_snr=-torch.inf if low is None else low,
        high_log_snr=torch.inf if high is None else high,
    )
    return SamplerConfig(chosen["solver"], chosen["nodes"], chosen["steps"], guidance)
