"""SEVA as a generator of views: windows of given and target views, guided as its authors guide them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import lru_cache, partial
from itertools import groupby, islice

import torch
from torch import Tensor

from cat3d_core.cameras import Cameras
from cat3d_core.diffusion.guidance import GuidanceConfig
from cat3d_core.diffusion.memory import Need
from cat3d_core.diffusion.sampler import SamplerConfig, evaluations
from cat3d_core.generation.memory import Memory
from cat3d_core.generation.protocol import Cost, GeneratorSpec, ViewGroup
from cat3d_core.seva.cameras import rays, scene_scale
from cat3d_core.seva.checkpoint import LICENCE
from cat3d_core.seva.config import SevaConfig
from cat3d_core.seva.guidance import ViewGuidance
from cat3d_core.seva.image_prompt import context
from cat3d_core.seva.model import SevaModel, seva_need
from cat3d_core.seva.network import count_flops
from cat3d_core.seva.sampler import Windows, sample
from cat3d_core.seva.schedule import SevaSchedule

#: As its authors sample: 50 Euler steps (which DDIM's are), guidance 3 of anchors.
REFERENCE = SamplerConfig("ddim", "trailing", 50, GuidanceConfig(3.0))
#: Guidance at most between anchors (the second pass), and of a view that is nearly a given one.
SECOND_PASS, LEAST = 2.0, 1.2


def seva_spec(
    config: SevaConfig, identity: str = "", encoder_identity: str = "", beside: int | None = None
) -> GeneratorSpec:
    """The spec of a network of SEVA's kind: windows of the configuration's number of square views of its size.

    beside: bytes of the autoencoder's and the image tower's weights; None: those of the published ones."""
    size = config.image_size
    return GeneratorSpec(
        views=config.views,
        given=tuple(range(1, config.views)),
        image_size=(size, size),
        latent_shape=(config.latent_channels, size // 8, size // 8),
        identity=identity,
        encoder_identity=encoder_identity,
        advice=REFERENCE,
        reference=REFERENCE,
        cost=partial(_cost, config),
        wants=frozenset({"images", "planned"}),
        layout="windows",
        terms=LICENCE,
        need=partial(_need, config, beside),
        at=partial(_at, config, identity, encoder_identity, beside),
    )


def _at(
    config: SevaConfig, identity: str, encoder_identity: str, beside: int | None, views: int | None, side: int | None
) -> GeneratorSpec:
    """The same weights for windows and images of other sizes: the network itself takes any."""
    other = replace(config, views=views or config.views, image_size=side or config.image_size)
    return seva_spec(other, identity, encoder_identity, beside)


def _cost(config: SevaConfig, given: int, targets: int, sampler: SamplerConfig) -> Cost:
    count = evaluations(sampler, SevaSchedule())
    return Cost(count, count * _flops(config, max(given + targets, config.views)))


@lru_cache(maxsize=8)
def _flops(config: SevaConfig, views: int) -> float:
    return float(count_flops(config, views))


def _need(config: SevaConfig, beside: int | None, groups: int, dtype: torch.dtype) -> Need:
    return seva_need(config, groups, dtype=dtype, beside=beside)


class SevaGenerator:
    """`Generator` over a SevaModel, on the device where its weights are."""

    def __init__(self, model: SevaModel, spec: GeneratorSpec | None = None) -> None:
        self.model = model
        self.spec = spec or seva_spec(model.config)
        self._memory = Memory(model.device)

    def encode(self, images: Tensor) -> Tensor:
        """Images (B, 3, H, W) in [0, 1], sides multiples of 64 -> latents (B, 4, H/8, W/8) float32."""
        return self.model.encode(images.to(self.model.device)).float().cpu()

    def decode(self, latents: Tensor) -> Tensor:
        """Latents (B, 4, h, w) -> images (B, 3, 8 h, 8 w) float32 in [0, 1]."""
        return self.model.decode(latents.to(self.model.device)).float().cpu()

    def sample(self, groups: Iterable[ViewGroup], sampler: SamplerConfig) -> Iterator[Tensor]:
        """Latents of each group's targets (see `Generator.sample`).

        Windows shorter than those of the spec are filled up with further copies of their targets, longer ones are
        taken as they are. A group's result is bit-identical with `micro_batch` 1. Raises ValueError for a group
        without the images of its given views.
        """
        at_once = sampler.micro_batch or 1
        for _, alike in groupby(groups, lambda group: (len(group.latents), len(group.noise))):
            while batch := list(islice(alike, at_once)):
                yield from self._together(batch, sampler, at_once)

    def _together(self, groups: list[ViewGroup], sampler: SamplerConfig, at_once: int) -> Tensor:
        """(G, N, C, h, w) for groups of one shape."""
        parts = [self._window(group, sampler.guidance.scale) for group in groups]
        windows = Windows(*(torch.stack(part).to(self.model.device) for part in zip(*(window for window, _ in parts))))
        noise = torch.stack([noise for _, noise in parts]).to(self.model.device)
        given, targets = len(groups[0].latents), len(groups[0].noise)

        def work(count: int) -> Tensor:
            out = sample(self.model.network, windows, noise, replace(sampler, micro_batch=count))
            return out[:, given : given + targets].cpu()

        return self._memory.run(work, at_once, f"window of {noise.shape[1]} views")

    def _window(self, group: ViewGroup, guidance: float) -> tuple[Windows, Tensor]:
        """One window without its leading dimension, and the noise of all its views."""
        if group.images is None:
            raise ValueError("SEVA needs the images of the given views, not their latents alone.")
        given, targets = len(group.latents), len(group.noise)
        copies = torch.arange(max(targets, self.spec.views - given)) % targets
        cameras = scene_scale(_all_cameras(group)).cameras(group.cameras)
        cameras = cameras[[*range(given), *(given + copies).tolist()]]
        is_given = torch.arange(len(cameras)) < given
        if _has_anchors(group):
            guidance = min(guidance, SECOND_PASS)
        scales = ViewGuidance("multiview", guidance, min(LEAST, guidance)).scales(cameras, is_given)
        noise = _all_noise(group.noise, given, copies)
        latents = torch.cat([group.latents, torch.zeros_like(noise[given:])])
        height, width = latents.shape[-2:]
        embedding = context(self.model.embed(group.images.to(self.model.device)).float().cpu())
        return Windows(latents, is_given, rays(cameras, height, width).float(), embedding, scales), noise


def _all_cameras(group: ViewGroup) -> Cameras:
    """Those whose middle and first one give the scene its scale: captured, then planned ones."""
    if group.scene is None:
        return group.cameras
    return group.scene if group.planned is None else Cameras.cat([group.scene, group.planned])


def _has_anchors(group: ViewGroup) -> bool:
    """Whether views made before are among the given ones: those that no captured camera stands for."""
    if group.scene is None:
        return False
    poses, known = group.cameras.world_from_camera[: len(group.latents)], group.scene.world_from_camera
    return not bool((poses[:, None] == known[None]).flatten(2).all(-1).any(1).all())


def _all_noise(noise: Tensor, given: int, copies: Tensor) -> Tensor:
    """Noise (V, C, h, w) of given views, of targets and of further copies of them, from that of the targets (N, C, h,
    w): each time it is used again it is moved on in space, which makes it fresh without another key."""
    targets, cells = len(noise), noise[0, 0].numel()
    order = [*copies.tolist(), *(view % targets for view in range(given))]
    rounds = -(-len(order) // targets)
    flat, used, out = noise.flatten(-2), [0] * targets, []
    for view in order:
        out.append(flat[view].roll(used[view] * (cells // rounds), -1))
        used[view] += 1
    ordered = torch.stack(out).unflatten(-1, noise.shape[-2:])
    return torch.cat([ordered[len(copies) :], ordered[: len(copies)]])
