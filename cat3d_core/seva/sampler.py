"""Sampling windows of views with SEVA's network: what is given, the denoiser, guidance view by view, our solvers.

`SamplerConfig.reference()` (DDIM, 50 trailing steps) is its own sampler, 50 Euler steps, up to the 1e-6 that it adds to
each noise level to divide by. All views of a window have a state, the given ones too: the unconditional half of the
guidance sees them as noise.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from cat3d_core.diffusion.sampler import SamplerConfig
from cat3d_core.diffusion.schedule import alpha_sigma
from cat3d_core.diffusion.solvers import integrate
from cat3d_core.seva.network import SevaUNet
from cat3d_core.seva.schedule import SevaSchedule

_SCHEDULE = SevaSchedule()


class Windows(NamedTuple):
    """G windows of V views. latents [G, V, 4, h, w] of the given views (elsewhere anything finite), given [G, V] bool,
    rays [G, V, 6, h, w] (`cameras.rays`), context [G, 1, C] (`image_prompt.context`), guidance [G, V]: scale of each
    view (`guidance.ViewGuidance`)."""

    latents: Tensor
    given: Tensor
    rays: Tensor
    context: Tensor
    guidance: Tensor

    def unconditional(self) -> Windows:
        """Nothing given and no embedding; the cameras stay known."""
        nothing = torch.zeros_like(self.given)
        return self._replace(given=nothing, context=torch.zeros_like(self.context))


@torch.no_grad()
def sample(network: SevaUNet, windows: Windows, noise: Tensor, config: SamplerConfig) -> Tensor:
    """Latents [G, V, 4, h, w] float32 of all views of the windows; those of given views mean nothing.

    noise [G, V, 4, h, w] standard normal, keyed by view. Of `config` the solver, the nodes, the steps, the interval of
    guidance and the micro-batch count; how strong guidance is stands in the windows. Raises ValueError for shapes that
    don't fit together.
    """
    shape = tuple(noise.shape)
    if tuple(windows.latents.shape) != shape or tuple(windows.given.shape) != shape[:2]:
        raise ValueError(
            f"Noise of {shape} needs latents of that shape and a mark of the given views {shape[:2]}; got "
            f"{tuple(windows.latents.shape)} and {tuple(windows.given.shape)}."
        )
    batch = config.micro_batch or len(noise)
    results = []
    for start in range(0, len(noise), batch):
        index = torch.arange(start, start + batch).clamp(max=len(noise) - 1).to(noise.device)
        part = _sample_batch(network, Windows(*(t[index] for t in windows)), noise[index].float(), config)
        results.append(part[: len(noise) - start])
    return torch.cat(results)


def _sample_batch(network: SevaUNet, windows: Windows, noise: Tensor, config: SamplerConfig) -> Tensor:
    nodes = _SCHEDULE.nodes(config.nodes, config.steps)

    def clean(x: Tensor, i: int) -> Tensor:
        return guided(network, windows, x, float(nodes[i]), config)

    return integrate(noise, torch.cat([nodes, nodes.new_tensor([math.inf])]), clean, config.solver)


def guided(network: SevaUNet, windows: Windows, x: Tensor, log_snr: float, config: SamplerConfig) -> Tensor:
    """The clean latents that views x [G, V, 4, h, w] (alpha clean + sigma noise) stand for, guided view by view where
    the noise level is in the interval of guidance."""
    limits = config.guidance
    inside = limits.low_log_snr <= log_snr <= limits.high_log_snr
    if not inside or bool((windows.guidance == 1).all()):
        return denoised(network, windows, x, log_snr)
    both = Windows(*(torch.cat([a, b]) for a, b in zip(windows.unconditional(), windows)))
    without, with_ = denoised(network, both, torch.cat([x, x]), log_snr).chunk(2)
    return without + windows.guidance[..., None, None, None].to(x) * (with_ - without)


def denoised(network: SevaUNet, windows: Windows, x: Tensor, log_snr: float) -> Tensor:
    """The same of one branch: given views are put in clean, and the noise that the network finds is taken away."""
    level = torch.tensor(log_snr, dtype=torch.float64)
    alpha, sigma = (float(part) for part in alpha_sigma(level))
    x = torch.where(windows.given[..., None, None, None], alpha * windows.latents.to(x), x)
    time = _SCHEDULE.time(level).to(x.device).expand(len(x))
    noise = network(x, time, windows.rays, windows.given, windows.context)
    return (x - sigma * noise.to(x)) / alpha
