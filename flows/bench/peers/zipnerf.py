"""Our reconstruction on a task of `compare`: a point at each power of two of the steps, and at the end."""

from __future__ import annotations

from flows.bench.peers.task import Curve, Row, Task, answer

# isort: split
import dataclasses

import numpy as np
import torch

from cat3d_core.cameras import Cameras
from cat3d_core.reconstruction import Views
from cat3d_core.zipnerf import PRESETS, Trainer, render_image
from flows.bench import limits
from flows.bench.counts import FieldCount


def measure(task: Task) -> list[Row]:
    """settings: preset, seed, threads, and `change`, settings that replace those of the preset."""
    torch.set_num_threads(task.settings["threads"])
    config = dataclasses.replace(PRESETS[task.settings["preset"]], lpips_weight=0.0, **task.settings.get("change", {}))

    def views(role: str) -> Views:
        images = [torch.from_numpy(image) for image in task.arrays[f"{role}_images"]]
        k, poses = (torch.from_numpy(task.arrays[f"{role}_{name}"]) for name in ("intrinsics", "cameras"))
        size = torch.tensor([[image.shape[1], image.shape[0]] for image in images])
        cameras = Cameras(k, poses, size)
        return Views.from_images(cameras, images, torch.ones(len(images), dtype=torch.bool))

    trainer, test = Trainer(config, views("train"), task.settings["seed"], "cpu"), views("test")
    curve = Curve(task.arrays["test_images"])

    def render(index: int) -> np.ndarray:
        return render_image(trainer.field, test.cameras, index, config).image.numpy()

    count = FieldCount(trainer.field)
    while not trainer.finished:
        with count:
            curve.train(trainer.step)
        done = trainer.iteration
        if trainer.finished or (done >= 32 and done & (done - 1) == 0):
            share = limits.columns(count.steps(done), curve.cpu_seconds / done, "cpu")
            curve.point(done, render, rays_per_s=done * config.batch_rays / curve.seconds, **share)
    return curve.rows


if __name__ == "__main__":
    answer(measure)
