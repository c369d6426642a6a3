"""diffusers' schedulers on the closed-form mixture of `cat3d bench sampler`, in the peers' environment.

Same problem, noise and guidance as ours, error against the same float64 reference of 1,000 steps; theirs get our noise
schedule as `trained_betas`. Ours is measured in the same process. Shares of limits are of the network's evaluations.
"""

from __future__ import annotations

from flows.bench.peers.task import Row, Task, answer

# isort: split
import time
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from cat3d_core.diffusion import GuidanceConfig, SamplerConfig, Schedule, sample
from cat3d_core.diffusion.sampler import evaluations
from cat3d_core.generation.advice import MEASURED
from flows.bench import limits
from flows.bench.sampler import REFERENCE, MixtureNetwork, evaluation_work, mixture_problem

SCALE = 3.0
#: Alphas of exactly zero have no log-SNR; this is what diffusers itself puts there.
SMALLEST = 2.0**-24


def measure(task: Task) -> list[Row]:
    """settings: groups, steps (a list), threads."""
    torch.set_num_threads(task.settings["threads"])
    model, latents, cameras, noise = mixture_problem(task.settings["groups"])
    guidance, network = GuidanceConfig(SCALE), cast(MixtureNetwork, model.unet)
    solver, nodes, count = REFERENCE
    model.unet.double()
    exact = SamplerConfig(solver, nodes, count, guidance)  # type: ignore[arg-type]
    reference = sample(model, latents.double(), cameras, noise.double(), exact)
    model.unet.float()

    one = evaluation_work((model, latents, cameras, noise), torch.float32)

    def row(who: str, name: str, steps: int, asked: int, run: Any) -> Row:
        started = time.perf_counter()
        out = run()
        seconds = (time.perf_counter() - started) / len(noise)
        error = (out.double() - reference).square().mean((1, 2, 3, 4)).sqrt().median()
        share = limits.columns(one * asked, seconds, dtype=torch.float64)  # the closed form is computed in float64
        return {"who": who, "setting": name, "steps": steps, "seconds": seconds, "error": float(error)} | share

    rows = []
    for steps in task.settings["steps"]:
        ours = SamplerConfig(MEASURED.solver, MEASURED.nodes, steps, guidance)
        asked = evaluations(ours, Schedule(model.config.schedule, noise.shape[1]))
        rows.append(row("cat3d", f"{ours.solver}, {ours.nodes}", steps, asked,
                        lambda ours=ours: sample(model, latents, cameras, noise, ours)))  # fmt: skip
        for name, scheduler in _schedulers(network.schedule.base_log_snr).items():
            rows.append(row("diffusers", name, steps, 2 * len(_timesteps(scheduler, steps)),
                            lambda one=scheduler, n=steps: _run(one, n, model, latents, cameras, noise)))  # fmt: skip
    return rows


def _schedulers(log_snr: Tensor) -> dict[str, Any]:
    import diffusers

    kept = log_snr.double().sigmoid().clamp(min=SMALLEST).numpy()
    betas = 1 - kept / np.concatenate([[1.0], kept[:-1]])
    common: dict[str, Any] = {
        "trained_betas": betas.tolist(), "prediction_type": "v_prediction", "timestep_spacing": "trailing",
        "num_train_timesteps": len(betas),
    }  # fmt: skip
    return {
        "DDIM": diffusers.DDIMScheduler(**common, clip_sample=False, set_alpha_to_one=True),
        "DPM-Solver++ (2M)": diffusers.DPMSolverMultistepScheduler(**common),
        "UniPC": diffusers.UniPCMultistepScheduler(**common),
    }


def _timesteps(scheduler: Any, steps: int) -> Any:
    scheduler.set_timesteps(steps)
    return scheduler.timesteps


@torch.no_grad()
def _run(scheduler: Any, steps: int, model: Any, latents: Tensor, cameras: Tensor, noise: Tensor) -> Tensor:
    x, given, groups = noise, latents.shape[1], len(noise)
    masks = [torch.zeros(groups, latents.shape[1] + noise.shape[1]) for _ in range(2)]
    masks[0][:, :given] = 1
    for step in _timesteps(scheduler, steps):
        inputs = torch.cat([latents, scheduler.scale_model_input(x, step)], 1)
        at = torch.full((groups,), float(step))
        guided, free = (model.unet(inputs, at, cameras, mask)[:, given:] for mask in masks)
        x = scheduler.step(free + SCALE * (guided - free), step, x).prev_sample
    return x


if __name__ == "__main__":
    answer(measure)
