"""Our own multi-view latent diffusion model as a generator."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import lru_cache, partial
from itertools import groupby, islice
from typing import Any

import torch
from torch import Tensor

from cat3d_core.diffusion.config import ModelConfig, UNetConfig
from cat3d_core.diffusion.hints import hint_latents
from cat3d_core.diffusion.memory import multiview_need
from cat3d_core.diffusion.model import MultiViewModel
from cat3d_core.diffusion.sampler import SamplerConfig, evaluations, sample
from cat3d_core.diffusion.schedule import Schedule
from cat3d_core.diffusion.unet import count_flops, count_parameters
from cat3d_core.generation.advice import MEASURED, PAPER
from cat3d_core.generation.memory import Memory
from cat3d_core.generation.protocol import Cost, GeneratorSpec, ViewGroup
from cat3d_core.rays import reference_from_image

#: Weights of a network whose need of memory is looked at before it is loaded (a quarter of the paper's).
_LARGE = 200_000_000


def cat3d_spec(
    config: ModelConfig, identity: str = "", encoder_identity: str = "", advice: dict[str, Any] | None = None
) -> GeneratorSpec:
    """The spec of a model. advice: what its file recommends, of solver, nodes, steps and guidance (a number); the rest
    is as measured."""
    advised = dict(advice or {})
    guidance = replace(MEASURED.guidance, scale=advised.pop("guidance", MEASURED.guidance.scale))
    size = config.unet.latent_size
    return GeneratorSpec(
        views=config.views,
        given=tuple(range(1, config.views)),
        image_size=(config.image_size, config.image_size),
        latent_shape=(config.unet.latent_channels, size, size),
        identity=identity,
        encoder_identity=encoder_identity,
        advice=replace(MEASURED, guidance=guidance, **advised),
        reference=replace(PAPER, guidance=replace(PAPER.guidance, scale=guidance.scale)),
        cost=partial(_cost, config),
        wants=frozenset({"hints"}) if config.unet.hints else frozenset(),
        need=partial(multiview_need, config) if count_parameters(config.unet) > _LARGE else None,
    )


def _cost(config: ModelConfig, given: int, targets: int, sampler: SamplerConfig) -> Cost:
    # Padded groups cost what full ones do.
    count = evaluations(sampler, Schedule(config.schedule, config.views - given), config.unet.hints)
    return Cost(count, count * _flops(config.unet, config.views))


@lru_cache(maxsize=8)
def _flops(unet: UNetConfig, views: int) -> float:
    return float(count_flops(unet, views))


class Cat3dGenerator:
    """`Generator` over a MultiViewModel, on the device where its weights are."""

    def __init__(self, model: MultiViewModel, spec: GeneratorSpec | None = None) -> None:
        self.model = model
        self.spec = spec or cat3d_spec(model.config)
        self.device = next(model.parameters()).device
        self._memory = Memory(self.device)

    @torch.no_grad()
    def encode(self, images: Tensor) -> Tensor:
        """Images (B, 3, H, W) in [0, 1], sides multiples of 8 -> latents (B, C, H/8, W/8) float32."""
        return self.model.autoencoder.encode(images.to(self.device)).float().cpu()

    @torch.no_grad()
    def decode(self, latents: Tensor) -> Tensor:
        """Latents (B, C, h, w) -> images (B, 3, 8 h, 8 w) float32 in [0, 1]."""
        return self.model.autoencoder.decode(latents.float().to(self.device)).cpu()

    def sample(self, groups: Iterable[ViewGroup], sampler: SamplerConfig) -> Iterator[Tensor]:
        """Latents of each group's targets (see `Generator.sample`).

        Short groups are filled up to the trained number of views, and the network always sees exactly the same number
        of groups, so that one shape is one result; a group's result is bit-identical with `micro_batch` 1. Raises
        ValueError for more views than the model takes.
        """
        at_once = sampler.micro_batch or 1
        for _, alike in groupby(groups, lambda group: (len(group.latents), len(group.noise), bool(group.hints))):
            while batch := list(islice(alike, at_once)):
                yield from self._together(batch, sampler, at_once)

    def _together(self, groups: list[ViewGroup], sampler: SamplerConfig, at_once: int) -> Tensor:
        """(G, N, C, h, w) for groups of one shape."""
        latents = torch.stack([group.latents for group in groups]).to(self.device)
        noise = torch.stack([group.noise for group in groups]).to(self.device)
        cameras = torch.stack([_matrices(group) for group in groups]).to(self.device)
        hints = None
        if "hints" in self.spec.wants and groups[0].hints:
            hints = torch.stack([hint_latents(self.model.autoencoder, group.hints) for group in groups])

        def work(count: int) -> Tensor:
            return sample(self.model, latents, cameras, noise, replace(sampler, micro_batch=count), hints).cpu()

        return self._memory.run(work, at_once, f"group of {cameras.shape[1]} views")


def _matrices(group: ViewGroup) -> Tensor:
    """(M + N, 4, 4): the cameras as the network takes them, seen from the first given view."""
    return reference_from_image(group.cameras, group.cameras.world_from_camera[0])
