"""What a model in training can do on held-out scenes: a picture to look at, and whether samples follow the cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from cat3d_core.cameras import Cameras
from cat3d_core.diffusion import GuidanceConfig, SamplerConfig
from cat3d_core.generation import Generator, generate
from cat3d_core.metrics.psnr import psnr
from cat3d_core.random import normal
from cat3d_core.synthetic.held_out import held_out_group
from cat3d_core.view_selection import camera_distance
from flows.media.images import write_png
from flows.training.hint_bank import told


@dataclass(frozen=True)
class HeldOut:
    """G groups of V views of scenes that are never trained on: images (G, V, 3, H, W) in [0, 1], one Cameras each."""

    families: tuple[str, ...]
    images: Tensor
    cameras: tuple[Cameras, ...]


def held_out(families: Sequence[str], scenes: int, size: int, views: int) -> HeldOut:
    """`scenes` held-out scenes of each family."""
    names = tuple(family for family in families for _ in range(scenes))
    groups = [held_out_group(family, number, size, views) for family in families for number in range(scenes)]
    images = torch.stack([traced.image for traced, _ in groups]).float()
    return HeldOut(names, images, tuple(cameras for _, cameras in groups))


def sampled(generator: Generator, scenes: HeldOut, given: int, steps: int) -> Tensor:
    """Images (G, V - given, 3, H, W) of the target views, given the first `given`; noise keyed by group and view.

    Targets beyond the model's group are sampled in further groups, so that models of other views can be compared."""
    sampler = SamplerConfig(steps=steps, guidance=GuidanceConfig(scale=1.0), micro_batch=min(len(scenes.images), 8))
    shape = generator.spec.latent_shape
    groups = [(images[:given], cameras) for images, cameras in zip(scenes.images, scenes.cameras, strict=True)]
    hints = [told(generator, *group) for group in groups]
    made = generate(generator, groups, sampler, lambda group, view: normal(shape, 0, "sheet", group, view), hints)
    return torch.stack(made)


def scores(images: Tensor, scenes: HeldOut, given: int, step: int) -> list[dict[str, Any]]:
    """A row of the table SAMPLES for each family: does a sample look like its own view more than like the others?"""
    out = []
    for family in dict.fromkeys(scenes.families):
        right, wrong, nearest, matched = [], [], [], []
        for group in (i for i, name in enumerate(scenes.families) if name == family):
            truth, made = scenes.images[group, given:], images[group]
            count = len(truth)
            pairs = psnr(made.repeat_interleave(count, 0), truth.repeat(count, 1, 1, 1)).reshape(count, count)
            right.append(float(pairs.diagonal().mean()))
            if count > 1:
                wrong.append(float((pairs.sum() - pairs.diagonal().sum()) / (count * (count - 1))))
                matched.append(float((pairs.argmax(1) == torch.arange(count)).double().mean()))
            order = camera_distance(scenes.cameras[group])[given:, :given].argmin(1)
            nearest.append(float(psnr(scenes.images[group][order], truth).mean()))
        out.append(
            {"step": step, "family": family, "condition_views": given, "psnr_right_db": _mean(right),
             "psnr_wrong_db": _mean(wrong), "psnr_nearest_db": _mean(nearest), "matched": _mean(matched)}
        )  # fmt: skip
    return out


def write_sheet(path: Path, images: Tensor, scenes: HeldOut, given: int, cell: int = 96) -> None:
    """Two lines a scene: the given views, a gap and the exact target views; below those the samples. Nothing is shown
    larger than `cell` pixels a side unless it is. One scene of each family is shown."""
    shown = [scenes.families.index(family) for family in dict.fromkeys(scenes.families)]
    images, originals = images[shown], scenes.images[shown]
    groups, views = originals.shape[:2]
    scale = max(1, cell // originals.shape[-1])
    exact = F.interpolate(originals.flatten(0, 1), scale_factor=scale, mode="nearest").unflatten(0, (groups, views))
    made = F.interpolate(images.flatten(0, 1), scale_factor=scale, mode="nearest").unflatten(0, images.shape[:2])
    side, gap = exact.shape[-1], 8
    sheet = torch.ones(3, groups * (2 * side + gap), views * side + gap)
    for group in range(groups):
        top = group * (2 * side + gap)
        for view in range(views):
            left = view * side + (gap if view >= given else 0)
            sheet[:, top : top + side, left : left + side] = exact[group, view]
            if view >= given:
                sheet[:, top + side : top + 2 * side, left : left + side] = made[group, view - given]
    path.parent.mkdir(parents=True, exist_ok=True)
    write_png(path, sheet.permute(1, 2, 0))


def _mean(values: list[float]) -> float | None:
    return sum(values) / len(values) if values else None
