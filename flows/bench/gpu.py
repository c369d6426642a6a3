"""The GPU's numbers of the reconstruction: kernels side by side, and the paper's two jobs against the clock.

    python -m flows.bench.gpu OUT [--seconds 90]      # OUT/kernels.json, OUT/jobs.json; tables on the screen

The jobs are the preset `paper` with the paper's rays a step (CAT3D, app. 'Details of 3D Reconstruction'), 1,000 steps.
Each goes on for at most `--seconds`; where that is not enough the time of all steps is that of the measured ones scaled
up, and `steps` says how many were measured. Views are procedural, without the LPIPS loss.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import time
from pathlib import Path
from typing import Any

import torch

from cat3d_core.zipnerf import PRESETS, Trainer
from flows.bench.reconstruct import kernels, procedural_views, train_and_measure

#: Rays a step, and the seconds that the whole job may take on one H200.
JOBS = {"single image": (2**16, 60), "few views": (2**20, 15 * 60)}
WARM_UP = 5  # steps in which kernels are compiled


def job(name: str, preset: str, rays: int, size: int, seconds: float, device: str) -> dict[str, Any]:
    """Steps of one job for at most `seconds`, and what all of them take."""
    config = dataclasses.replace(PRESETS[preset], batch_rays=rays, lpips_weight=0.0)
    train, test, depths = procedural_views("mip360", 24, 3, size, size)
    trainer = Trainer(config, train, 0, device)
    for _ in range(WARM_UP):
        trainer.step()
    synchronize(device)
    started, steps = time.perf_counter(), 0
    while time.perf_counter() - started < seconds and not trainer.finished:
        trainer.step()
        synchronize(device)
        steps += 1
    spent = time.perf_counter() - started
    row: dict[str, Any] = {
        "job": name,
        "preset": preset,
        "rays": rays,
        "steps": steps,
        "seconds": spent,
        "rays_per_s": steps * rays / spent,
        "seconds_of_all_steps": spent / steps * config.iterations,
        "skipped": trainer.skipped,
    }
    if device == "cuda":
        row["peak_gib"] = torch.cuda.max_memory_allocated() / 2**30
    if row["seconds_of_all_steps"] <= seconds:
        row |= train_and_measure(config, train, test, depths, device)
    return row


def synchronize(device: str) -> None:
    if device == "cuda":
        torch.cuda.synchronize()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--seconds", type=float, default=90.0, help="at most, for each job")
    parser.add_argument("--preset", default="paper")
    parser.add_argument("--divide", type=int, default=1, help="rays of a job divided by this, to try the script out")
    parser.add_argument("--size", type=int, default=256, help="side of the views in pixels")
    options = parser.parse_args()
    device = "cuda" if torch.cuda.is_available() else "cpu"
    options.out.mkdir(parents=True, exist_ok=True)
    rows = kernels(2**14 // options.divide, repeats=3, device=device, threads=(1,))
    (options.out / "kernels.json").write_text(json.dumps(rows, indent=1))
    for row in (row for row in rows if row["grid"] == "all"):
        print({name: row[name] for name in ("workload", "phase", "kernel", "ms", "ratio")}, flush=True)
    done = []
    for name, (rays, within) in JOBS.items():
        done.append(job(name, options.preset, rays // options.divide, options.size, options.seconds, device))
        done[-1]["within_s"] = within
        (options.out / "jobs.json").write_text(json.dumps(done, indent=1))
        print(done[-1], flush=True)


if __name__ == "__main__":
    main()
