"""Sampling groups of views: schedule, guidance and solver put together in one loop."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

import torch
from torch import Tensor

from cat3d_core.diffusion.conditioning import Condition, make_condition
from cat3d_core.diffusion.config import HINT_MAPS
from cat3d_core.diffusion.guidance import GuidanceConfig, guided
from cat3d_core.diffusion.hints import CONFIDENCE
from cat3d_core.diffusion.model import MultiViewModel
from cat3d_core.diffusion.schedule import Nodes, Schedule, alpha_sigma
from cat3d_core.diffusion.solvers import check_solver, integrate

Start = Literal["noise", "hint"]
#: log-SNR from which on the latents of a trusted hint are a better start than pure noise.
START = -2.0


@dataclass(frozen=True)
class SamplerConfig:
    """How to sample. The paper's reference mode is DDIM, 50 steps, guidance 3 (`SamplerConfig.reference()`).

    micro_batch: always run the network on exactly this many groups (the last batch is filled up by repetition), so that
    kernels see one shape only. With 1, a group's result is bit-identical however many groups are sampled with it.
    start: "hint" begins, for groups with hints, at the first noise level with a log-SNR of START at least, from the
    hints' latents where they are trusted. Raises ValueError for a solver that there isn't.
    """

    solver: str = "unipc"
    nodes: Nodes = "log_snr"
    steps: int = 20
    guidance: GuidanceConfig = field(default_factory=GuidanceConfig)
    micro_batch: int | None = None
    start: Start = "noise"

    def __post_init__(self) -> None:
        check_solver(self.solver)

    @classmethod
    def reference(cls) -> SamplerConfig:
        return cls("ddim", "trailing", 50)


def evaluations(config: SamplerConfig, schedule: Schedule, hinted: bool = False) -> int:
    """How often a group (hinted: one with hints) goes through the network: once a step, and once more where guidance is
    on."""
    levels = _nodes(config, schedule, hinted).tolist()
    return sum(2 if config.guidance.active(level) else 1 for level in levels)


def sample(
    model: MultiViewModel, condition_latents: Tensor, cameras: Tensor, noise: Tensor, config: SamplerConfig,
    hints: Tensor | None = None,
) -> Tensor:  # fmt: skip
    """Latents of target views given conditioning views, for G independent groups.

    condition_latents [G, M, C, h, w]; cameras [G, M+N, 4, 4], conditioning views first, seen from the first of them
    (`rays.reference_from_image`); noise [G, N, C, h, w] standard normal, keyed by view; hints [G, N, C + 4, h, w] of
    the targets (hints.py), for a model that takes them. Returns [G, N, C, h, w] float32 (float64 for float64 noise; the
    network runs in the dtype of its weights).
    Groups with fewer targets than the model was trained with (views - M) are padded with repeated targets, keeping the
    trained noise shift; the padding is dropped. Raises ValueError for shapes that don't fit together.
    """
    groups, given = condition_latents.shape[:2]
    targets = noise.shape[1]
    views = model.config.views
    if noise.shape[0] != groups or cameras.shape[:2] != (groups, given + targets):
        raise ValueError(
            f"{groups} groups of {given} conditioning and {targets} target views need cameras [{groups}, "
            f"{given + targets}, 4, 4] and noise [{groups}, {targets}, C, h, w]; got cameras {tuple(cameras.shape)} "
            f"and noise {tuple(noise.shape)}."
        )
    if given < 1 or targets < 1 or given + targets > views:
        raise ValueError(
            f"A group of this model has at least one conditioning and one target view and at most {views} views in "
            f"all; got {given} + {targets}. Split the targets into more groups."
        )
    dtype = torch.promote_types(noise.dtype, torch.float32)  # of the state
    inputs = [condition_latents.to(dtype), *_pad_targets(cameras.double(), noise.to(dtype), views - given)]
    if hints is not None:
        inputs.append(hints.to(dtype)[:, torch.arange(views - given) % targets])
    batch = config.micro_batch or groups
    results = []
    for start in range(0, groups, batch):
        index = torch.arange(start, start + batch).clamp(max=groups - 1)
        part = _sample_batch(model, [t[index.to(t.device)] for t in inputs], config)
        results.append(part[: min(batch, groups - start), :targets])
    return torch.cat(results)


def _pad_targets(cameras: Tensor, noise: Tensor, full: int) -> tuple[Tensor, Tensor]:
    """Repeat target views up to `full`. A repeated view gets its own noise, moved around in space: fresh noise without
    another key (the same noise twice would look to the network like a cleaner picture)."""
    targets = noise.shape[1]
    index = torch.arange(full)
    cells = noise[0, 0, 0].numel()
    rounds = -(-full // targets)
    flat = noise.flatten(-2)
    padded = torch.cat([flat.roll(round_ * (cells // rounds), -1) for round_ in range(rounds)], 1)[:, :full]
    given = cameras.shape[1] - targets
    return (
        torch.cat([cameras[:, :given], cameras[:, given + (index % targets)]], 1),
        padded.unflatten(-1, noise.shape[-2:]),
    )


@torch.no_grad()
def _sample_batch(model: MultiViewModel, inputs: list[Tensor], config: SamplerConfig) -> Tensor:
    latents, cameras, x = inputs[:3]
    hints = inputs[3] if len(inputs) > 3 else None
    schedule = Schedule(model.config.schedule, x.shape[1])
    nodes = _nodes(config, schedule, hints is not None)
    times = schedule.time(nodes).tolist()
    condition = make_condition(latents, cameras, hints)
    if hints is not None and config.start == "hint":
        x = _from_hint(hints, x, nodes[0])

    def clean(x: Tensor, i: int) -> Tensor:
        def predict(given: Condition, x: Tensor) -> Tensor:
            time = torch.full((x.shape[0],), times[i], device=x.device, dtype=x.dtype)
            full = torch.cat([given.latents, x], 1)
            out: Tensor = model.unet(full, time, given.cameras, given.mask, given.hints)
            return out[:, given.latents.shape[1] :].to(x.dtype)

        prediction = guided(predict, condition, x, float(nodes[i]), config.guidance)
        return schedule.clean(x, prediction, nodes[i])

    to_clean = torch.cat([nodes, nodes.new_tensor([math.inf])])
    return integrate(x, to_clean, clean, config.solver)


def _nodes(config: SamplerConfig, schedule: Schedule, hinted: bool) -> Tensor:
    """The noise levels; for a start from hints without those below START (the last one stays)."""
    nodes = schedule.nodes(config.nodes, config.steps)
    if not hinted or config.start == "noise":
        return nodes
    return nodes[(nodes >= START) | (torch.arange(len(nodes)) == len(nodes) - 1)]


def _from_hint(hints: Tensor, noise: Tensor, log_snr: Tensor) -> Tensor:
    """What a view would be at this noise level if the latents of its hint [G, N, C + 4, h, w] were right; noise, as far
    as they are not trusted."""
    alpha, sigma = (float(part) for part in alpha_sigma(log_snr.double()))
    trusted = alpha * hints[:, :, CONFIDENCE, None]
    return trusted * hints[:, :, : -len(HINT_MAPS)] + (1 - trusted.square()).clamp_min(sigma**2).sqrt() * noise
