"""Procedural scenes: views rendered a second, per family, on the CPU and on a GPU where there is one."""

from __future__ import annotations

import time
from functools import partial
from typing import Any

import torch

from cat3d_core.cameras import Cameras
from cat3d_core.synthetic import FAMILIES, Scene, random_cameras, random_scene, render_views
from flows.bench import limits
from flows.bench.counts import FLOAT, counted


def rows(size: int = 128, views: int = 8, repeats: int = 3) -> list[dict[str, Any]]:
    """Best of `repeats`: seconds and views a second for `size` x `size` images at 2 x 2 rays a pixel; 1 scene at a time
    on the CPU, 16 on a GPU (scenes are batched there, to fill it). Shares of the machine's limits (`limits`) are of
    what torch is asked for, and of the images alone."""
    out = []
    for device in ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]:
        scenes = 1 if device == "cpu" else 16
        for family in FAMILIES:
            batch = [random_scene(family, seed) for seed in range(scenes)]
            cameras = Cameras.cat([random_cameras(s, 0, views, size, size) for s in batch]).to(device, torch.float32)
            scene = Scene.stack(batch).to(device)
            best = float("inf")
            for _ in range(repeats + 1):  # the first warms up
                start = time.perf_counter()
                render_views(scene, cameras)
                if device == "cuda":
                    torch.cuda.synchronize()
                best = min(best, time.perf_counter() - start)
            count = scenes * views
            flops = counted(partial(render_views, scene, cameras))
            work = limits.Work(flops, float(3 * FLOAT * count * size * size))
            out.append(
                {"benchmark": "render", "family": family, "device": device, "size": size, "scenes": scenes,
                 "threads": torch.get_num_threads(), "time_s": round(best, 4), "views_per_s": round(count / best, 1),
                 **limits.columns(work, best, device=device)}
            )  # fmt: skip
    return out


if __name__ == "__main__":
    for row in rows():
        print("  ".join(f"{key}={value}" for key, value in row.items()))
