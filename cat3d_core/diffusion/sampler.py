"""Sampling groups of views: schedule, guidance and solver put together in one loop."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import torch
from torch import Tensor

from cat3d_core.diffusion.conditioning import Condition, make_condition
from cat3d_core.diffusion.guidance import GuidanceConfig, guided
from cat3d_core.diffusion.model import MultiViewModel
from cat3d_core.diffusion.schedule import Nodes, Schedule
from cat3d_core.diffusion.solvers import check_solver, integrate


@dataclass(frozen=True)
class SamplerConfig:
    """How to sample. The paper's reference mode is DDIM, 50 steps, guidance 3 (`SamplerConfig.reference()`).

    micro_batch: always run the network on exactly this many groups (the last batch is filled up by repetition), so that
    kernels see one shape only. With 1, a group's result is bit-identical however many groups are sampled with it.
    Raises ValueError for a solver that there isn't.
    """

    solver: str = "unipc"
    nodes: Nodes = "log_snr"
    steps: int = 20
    guidance: GuidanceConfig = field(default_factory=GuidanceConfig)
    micro_batch: int | None = None

    def __post_init__(self) -> None:
        check_solver(self.solver)

    @classmethod
    def reference(cls) -> SamplerConfig:
        return cls("ddim", "trailing", 50)


def evaluations(config: SamplerConfig, schedule: Schedule) -> int:
    """How often a group goes through the network: once a step, and once more where guidance is on."""
    levels = schedule.nodes(config.nodes, config.steps).tolist()
    return sum(2 if config.guidance.active(level) else 1 for level in levels)


def sample(
    model: MultiViewModel, condition_latents: Tensor, cameras: Tensor, noise: Tensor, config: SamplerConfig
) -> Tensor:
    """Latents of target views given conditioning views, for G independent groups.

    condition_latents [G, M, C, h, w]; cameras [G, M+N, 4, 4], conditioning views first, seen from the first of them
    (`rays.reference_from_image`); noise [G, N, C, h, w] standard normal, keyed by view. Returns [G, N, C, h, w] float32
    (float64 for float64 noise; the network runs in the dtype of its weights).
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
    latents, cameras, noise = inputs
    schedule = Schedule(model.config.schedule, noise.shape[1])
    nodes = schedule.nodes(config.nodes, config.steps)
    times = schedule.time(nodes).tolist()
    condition = make_condition(latents, cameras)

    def clean(x: Tensor, i: int) -> Tensor:
        def predict(given: Condition, x: Tensor) -> Tensor:
            time = torch.full((x.shape[0],), times[i], device=x.device, dtype=x.dtype)
            full = torch.cat([given.latents, x], 1)
            return model.unet(full, time, given.cameras, given.mask)[:, given.latents.shape[1] :].to(x.dtype)

        prediction = guided(predict, condition, x, float(nodes[i]), config.guidance)
        return schedule.clean(x, prediction, nodes[i])

    to_clean = torch.cat([nodes, nodes.new_tensor([math.inf])])
    return integrate(noise, to_clean, clean, config.solver)
