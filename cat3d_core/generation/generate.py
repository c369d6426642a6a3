"""From pictures to pictures: encode the given views, sample the others, decode."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor

from cat3d_core.cameras import Cameras
from cat3d_core.diffusion.sampler import SamplerConfig
from cat3d_core.generation.protocol import Generator, ViewGroup


def generate(
    generator: Generator,
    scenes: Sequence[tuple[Tensor, Cameras]],
    sampler: SamplerConfig,
    noise: Callable[[int, int], Tensor],
    hints: Sequence[Mapping[str, Tensor]] = (),
) -> list[Tensor]:
    """Images (N, 3, H, W) in [0, 1] of the target views of each scene.

    scenes: images (M, 3, H, W) in [0, 1] of the given views, and the M + N cameras of given and target views, scene
    frame. noise(scene, view) -> (C, h, w), standard normal; views are counted from the first given one. hints: of the
    targets of each scene (`ViewGroup.hints`), if there are any. More targets than the generator takes at once are
    sampled in several groups.
    """
    latents = [generator.encode(images) for images, _ in scenes]
    groups, scene_of = [], []
    for part in range(max(len(cameras) for _, cameras in scenes)):  # alike ones together
        for number, (images, cameras) in enumerate(scenes):
            given, at_once = len(images), generator.spec.views - len(images)
            targets = range(given, len(cameras))[part * at_once : (part + 1) * at_once]
            if not targets:
                continue
            group = ViewGroup(
                latents[number],
                cameras[[*range(given), *targets]],
                torch.stack([noise(number, view) for view in targets]),
                images=images,
                scene=cameras[:given],
                hints={name: m[[t - given for t in targets]] for name, m in hints[number].items()} if hints else {},
            )
            groups.append(group)
            scene_of.append(number)
    made: list[list[Tensor]] = [[] for _ in scenes]
    for number, sampled in zip(scene_of, generator.sample(groups, sampler), strict=True):
        made[number].append(generator.decode(sampled))
    return [torch.cat(parts) for parts in made]
