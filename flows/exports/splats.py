"""A finished run as splats: its own, or made of what its field renders."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path

import torch

from cat3d_core.cameras import Cameras
from cat3d_core.normalization import Similarity
from cat3d_core.reconstruction import Reconstructor, Render, Views
from cat3d_core.splats import REFINE, Gaussians, Splats, SplatTrainer, from_renders
from flows.errors import InputError
from flows.exports.splat_files import WRITERS
from flows.media.images import to_uint8
from flows.progress import meter

MOST = 200_000
"""Splats at most: 14 MB as .ply, 6 MB as .splat, and what a browser without a graphics card still turns."""


def splats_of(
    scene: Reconstructor, renders: Sequence[Render], cameras: Cameras, most: int = MOST,
    steps: int = REFINE.iterations, before_each: Callable[[], object] = bool,
) -> Gaussians:  # fmt: skip
    """At most `most` Gaussians (scene frame): those of splats themselves; of another reconstruction those of its
    renders, refined in so many steps to look like them. `before_each` is called before each step; it may wait, or raise
    to end the work."""
    if isinstance(scene, Splats):
        found = scene.gaussians.to("cpu")
        # What is seen least is left out first.
        kept = (found.opacities * found.scales.prod(1).pow(2 / 3)).argsort(descending=True, stable=True)[:most]
        return found[kept.sort().values]
    first = from_renders(renders, cameras.to(dtype=torch.float32), most)
    if not steps:
        return first
    images = [torch.from_numpy(to_uint8(render.image)) for render in renders]
    views = Views.from_images(cameras, images, torch.ones(len(images), dtype=torch.bool))
    trainer = SplatTrainer(dataclasses.replace(REFINE, iterations=steps), views, 0, first=first)
    with meter("refine the splats", steps) as progress:
        while not trainer.finished:
            before_each()
            numbers = trainer.step()
            progress.advance(note=f"{numbers['psnr']:.1f} dB")
    return trainer.gaussians.detach()


def write_splats(folder: Path, gaussians: Gaussians, frame_from_scene: Similarity) -> tuple[list[Path], list[str]]:
    """Write splats.ply, splats.splat and splats.spz in the frame asked for; the files made, and why others were not."""
    mapped = gaussians.mapped(frame_from_scene)
    made, lacking = [], []
    for suffix, write in WRITERS.items():
        path = folder / f"splats{suffix}"
        try:
            write(path, mapped)
        except InputError as error:
            lacking.append(str(error))
        else:
            made.append(path)
    return made, lacking
