"""nerfstudio's nerfacto on a task of `compare`, in the peers' environment, with its own settings.

Its torch implementation (tiny-cuda-nn needs CUDA), its optimisers and learning rates. Changed: the cameras stay as they
are given, as ours do; half precision is for CUDA; the rays of a step are a setting (its own: 4,096), since a CPU takes
seconds for one step of so many.
"""

from __future__ import annotations

from flows.bench.peers.task import Curve, Row, Task, answer

# isort: split
from typing import Any

import numpy as np
import torch

from flows.bench.peers.torchvision_cpu import allow_torchvision

RENDERED_AT_ONCE = 8192


def measure(task: Task) -> list[Row]:
    """settings: seconds (of training), rays (a step), seed, threads. Points at 1/16, 1/8, 1/4, 1/2 and all of them."""
    torch.set_num_threads(task.settings["threads"])
    torch.manual_seed(task.settings["seed"])
    allow_torchvision()
    from nerfstudio.cameras.cameras import Cameras
    from nerfstudio.data.scene_box import SceneBox
    from nerfstudio.engine.callbacks import TrainingCallbackAttributes, TrainingCallbackLocation
    from nerfstudio.engine.optimizers import AdamOptimizerConfig
    from nerfstudio.engine.schedulers import ExponentialDecaySchedulerConfig

    def cameras(role: str) -> Cameras:
        poses = torch.from_numpy(task.arrays[f"{role}_cameras"]).float()[:, :3]
        k = torch.from_numpy(task.arrays[f"{role}_intrinsics"]).float()
        height, width = task.arrays[f"{role}_images"].shape[1:3]
        opengl = poses * torch.tensor([1.0, -1, -1, 1])
        return Cameras(opengl, k[:, 0, 0], k[:, 1, 1], k[:, 0, 2], k[:, 1, 2], width, height)

    train, test = cameras("train"), cameras("test")
    images = torch.from_numpy(task.arrays["train_images"]).float() / 255
    decay = ExponentialDecaySchedulerConfig(lr_final=1e-4, max_steps=200_000)
    box = SceneBox(aabb=torch.tensor([[-1.0, -1, -1], [1, 1, 1]]))
    model = untrained(box, len(images))
    optimisers, schedules = [], []
    for name, parameters in model.get_param_groups().items():
        if name in ("proposal_networks", "fields"):
            optimiser = AdamOptimizerConfig(lr=1e-2, eps=1e-15).setup(parameters)
            optimisers.append(optimiser)
            schedules.append(decay.setup().get_scheduler(optimiser, 1e-2))
    callbacks = model.get_training_callbacks(
        TrainingCallbackAttributes(optimizers=None, grad_scaler=None, pipeline=None, trainer=None)
    )
    random = np.random.default_rng(task.settings["seed"])
    curve = Curve(task.arrays["test_images"])
    count, height, width = images.shape[:3]
    at_step, rays = 0, task.settings["rays"]

    def step() -> None:
        for callback in callbacks:
            callback.run_callback_at_location(at_step, TrainingCallbackLocation.BEFORE_TRAIN_ITERATION)
        view, y, x = (torch.from_numpy(random.integers(0, end, rays)) for end in (count, height, width))
        bundle = train.generate_rays(view[:, None], torch.stack([y, x], -1) + 0.5)
        outputs = model(bundle)
        batch = {"image": images[view, y, x], "indices": torch.stack([view, y, x], -1)}
        metrics = model.get_metrics_dict(outputs, batch)
        loss = sum(model.get_loss_dict(outputs, batch, metrics).values())
        for optimiser in optimisers:
            optimiser.zero_grad()
        loss.backward()  # type: ignore[union-attr]
        for optimiser, schedule in zip(optimisers, schedules, strict=True):
            optimiser.step()
            schedule.step()
        for callback in callbacks:
            callback.run_callback_at_location(at_step, TrainingCallbackLocation.AFTER_TRAIN_ITERATION)

    @torch.no_grad()
    def render(index: int) -> np.ndarray:
        model.eval()
        bundle = test.generate_rays(index, keep_shape=True)
        image = model.get_outputs_for_camera_ray_bundle(bundle)["rgb"]
        model.train()
        return image.cpu().numpy()

    model.train()
    for share in (1 / 16, 1 / 8, 1 / 4, 1 / 2, 1):
        while curve.seconds < share * task.settings["seconds"]:
            curve.train(step)
            at_step += 1
        curve.point(at_step, render, rays_per_s=at_step * rays / curve.seconds)
    return curve.rows


def untrained(box: Any, views: int) -> Any:
    """Its model in torch alone, for the scene box of so many training views whose cameras stay as they are."""
    from nerfstudio.models import nerfacto
    from torchmetrics.image import lpip

    # Its LPIPS, which only its own evaluation uses, would fetch weights.
    vars(lpip)["LearnedPerceptualImagePatchSimilarity"] = lambda **_: torch.nn.Identity()
    # What its table of methods has for nerfacto; that table itself imports every method it knows.
    config = nerfacto.NerfactoModelConfig(
        eval_num_rays_per_chunk=RENDERED_AT_ONCE, average_init_density=0.01, implementation="torch"
    )
    config.camera_optimizer.mode = "off"
    return config.setup(scene_box=box, num_train_data=views, metadata={}, device="cpu", grad_scaler=None)


if __name__ == "__main__":
    answer(measure)
