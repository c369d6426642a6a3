"""diffusers' U-Net beside ours, both of the shipped model's size, in one process of the peers' environment.

They are not one network (ours attends over all views of a group), so each is held against its own arithmetic:
`gflop_per_s`, and its share of what a large matrix product reaches on the same threads (`flows/bench/limits.py`).
"""

from __future__ import annotations

from flows.bench.peers.task import Row, Task, answer

# isort: split
from collections.abc import Callable
from typing import Any

import torch

from cat3d_core.diffusion import load_model
from cat3d_core.weights import default_model_path
from flows.bench import limits
from flows.bench.counts import counted, network_bytes
from flows.bench.peers.torchvision_cpu import allow_torchvision


def measure(task: Task) -> list[Row]:
    """settings: groups, repeats, threads."""
    allow_torchvision()
    import diffusers

    torch.set_num_threads(task.settings["threads"])
    groups, repeats = task.settings["groups"], task.settings["repeats"]
    model = load_model(default_model_path())
    config, size = model.config, model.config.unet.latent_size
    views, channels = config.views, config.unet.latent_channels
    latents, mask = torch.randn(groups, views, channels, size, size), torch.ones(groups, views)
    cameras = torch.eye(4).repeat(groups, views, 1, 1)
    widths = tuple(config.unet.channels)
    theirs: Any = diffusers.UNet2DModel(
        sample_size=size, in_channels=channels, out_channels=channels, block_out_channels=widths,
        down_block_types=("AttnDownBlock2D",) * len(widths), up_block_types=("AttnUpBlock2D",) * len(widths),
        layers_per_block=2, norm_num_groups=16, attention_head_dim=32,
    )  # fmt: skip
    theirs.eval()
    flat, steps = latents.flatten(0, 1), torch.full((groups,), 500.0)
    runs: dict[str, tuple[torch.nn.Module, Callable[[], Any]]] = {
        "cat3d": (model.unet, lambda: model.unet(latents, steps, cameras, mask)),
        "diffusers": (theirs, lambda: theirs(flat, 500).sample),
    }
    rows = []
    with torch.no_grad():
        for who, (network, run) in runs.items():
            work = limits.Work(counted(run), network_bytes(network) + 2 * flat.numel() * flat.element_size())
            seconds = limits.best_seconds(run, repeats=repeats)
            rows.append(
                {"who": who, "setting": f"{sum(p.numel() for p in network.parameters()) / 1e6:.1f} M parameters",
                 "seconds": seconds / (groups * views), **limits.columns(work, seconds)}
            )  # fmt: skip
    return rows


if __name__ == "__main__":
    answer(measure)
