"""How a job samples: the run's own settings, else what its generator advises."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

from cat3d_core.diffusion import GuidanceConfig, SamplerConfig
from flows.generation.open import generator_spec
from flows.jobs.job import Job
from schemas.errors import ConfigError

_CHOSEN = ("solver", "nodes", "steps")


def sampler_config(job: Job, shortened: bool | None = None) -> SamplerConfig:
    """Solver, nodes, steps and guidance: the run's own where given, else the generator's advice; without `skip.solver`
    its authors' sampler, except for guidance, which is no skip and stays the generator's. Without `skip.guidance`, or
    where guidance changes nothing, it has no interval. shortened: in place of `skip.solver`. Raises ConfigError for a
    sampler that doesn't exist.
    """
    settings, skip, spec = job.config.sample, job.config.skip, generator_spec(job)
    base = spec.advice if (skip.solver if shortened is None else shortened) else spec.reference
    advised = spec.advice.guidance
    scale = advised.scale if settings.guidance is None else settings.guidance
    low, high = -math.inf, math.inf
    if skip.guidance and scale != 1:
        asked = settings.guidance_log_snr
        low, high = (_bounds(*asked)) if asked else (advised.low_log_snr, advised.high_log_snr)
    own = {name: value for name in _CHOSEN if (value := getattr(settings, name)) is not None}
    try:
        guidance = replace(base.guidance, scale=scale, low_log_snr=low, high_log_snr=high)
        at_once = job.config.execution.groups_at_once
        return replace(base, **own, guidance=guidance, micro_batch=at_once, start=settings.start)
    except ValueError as error:
        raise ConfigError(f"The settings of `sample` don't work: {error}") from None


def sampler_settings(job: Job) -> dict[str, Any]:
    """All that decides how the job samples, as JSON values: part of the content key of what is sampled."""
    config = sampler_config(job)
    chosen = {name: getattr(config, name) for name in _CHOSEN} | {"guidance": config.guidance.scale}
    if config.start != "noise":
        chosen |= {"start": config.start}
    return chosen | {"guidance_log_snr": _interval(config.guidance), "near_steps": job.config.skip.near_steps}


def _bounds(low: float | None, high: float | None) -> tuple[float, float]:
    return -math.inf if low is None else low, math.inf if high is None else high


def _interval(guidance: GuidanceConfig) -> list[float | None]:
    return [bound if math.isfinite(bound) else None for bound in (guidance.low_log_snr, guidance.high_log_snr)]
