"""Sampling in the largest batch that memory holds: out of memory, the batch is halved and tried again."""

from __future__ import annotations

import gc
from dataclasses import replace

import torch
from torch import Tensor

from cat3d_core.diffusion import MultiViewModel, SamplerConfig, sample
from flows.errors import WorkerError


def sample_at_most(
    at_once: int, model: MultiViewModel, tensors: tuple[Tensor, Tensor, Tensor], config: SamplerConfig
) -> tuple[Tensor, int]:
    """Latents [G, N, C, h, w] of the groups, sampled `at_once` or fewer together, and how many fitted.

    The network always sees exactly that many groups (see SamplerConfig.micro_batch), so that one shape is one result.
    Raises WorkerError when memory doesn't hold a single group.
    """
    device = next(model.parameters()).device
    while True:
        try:
            latents, raymaps, noise = (t.to(device) for t in tensors)
            return sample(model, latents, raymaps, noise, replace(config, micro_batch=at_once)), at_once
        except (torch.OutOfMemoryError, MemoryError, RuntimeError) as error:
            if not out_of_memory(error):
                raise
            if at_once == 1:
                raise WorkerError(
                    f"Memory doesn't hold one group of {tensors[1].shape[1]} views on {device} ({error}): "
                    "use a smaller model, sample.precision bfloat16, or a device with more memory."
                ) from None
            at_once //= 2
        # Outside the handler: inside, the traceback still holds the activations.
        gc.collect()
        if device.type == "cuda":
            torch.cuda.empty_cache()


def out_of_memory(error: BaseException) -> bool:
    """Whether an allocation failed; PyTorch's CPU allocator raises a plain RuntimeError."""
    text = str(error)
    return isinstance(error, (torch.OutOfMemoryError, MemoryError)) or "can't allocate memory" in text
