"""A scene small enough to sample in seconds, as far as `encode`; run as a program it samples and decodes a job."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path
from typing import Any

import torch

from cat3d_core.diffusion import SIZES, MultiViewModel, save_model
from flows.jobs.job import Job
from flows.jobs.request import Request, make_config
from flows.pipeline.keys import pending
from flows.pipeline.runner import execute_stage, opened, prepare_run
from schemas.scene_store import Run, SceneStore
from schemas.stages import StageRecord

SOURCE = "procedural:dtu/3?views=9&width=32&height=24"
VIEWS = 24


def random_model(path: Path, **unet: Any) -> Path:
    """A tiny model with random weights, none of them zero, so that every input has an effect; unet: fields of its
    configuration that differ."""
    torch.manual_seed(0)
    config = SIZES["tiny"]
    model = MultiViewModel(dataclasses.replace(config, unet=dataclasses.replace(config.unet, **unet)))
    for weight in model.parameters():
        if not weight.abs().max():
            torch.nn.init.normal_(weight, 0, 0.02)
    save_model(path, model, {"data": "none: random weights for tests"})
    return path


def make_job(out: Path, checkpoint: Path, split: str = "3", count: int = VIEWS, **execution: Any) -> Job:
    """A cat3d run of `count` views in 12 steps: long enough to be interrupted."""
    document = [f"sample.checkpoint={checkpoint}", "sample.steps=12", f"plan.views={count}", "seed=5", "method=cat3d"]
    settings = [*document, *(f"execution.{name}={value}" for name, value in execution.items())]
    return Request(SOURCE, out, (split,), make_config({}, None, settings)).jobs()[0]


def run_stages(job: Job, *stages: str) -> dict[str, StageRecord]:
    """Run those of the stages that are pending, in this process; their records."""
    with opened(job):
        prepare_run(job)
        return {step.stage: execute_stage(job, step) for step in pending(job) if step.stage in stages}


def prepare(job: Job) -> None:
    """Everything up to sampling."""
    run_stages(job, "ingest", "poses", "plan", "encode")


def run_of(job: Job) -> Run:
    return SceneStore.open(job.store_path).run(job.run)


def chunk_times(job: Job) -> dict[int, tuple[int, int]]:
    """(inode, time of change) of the latent of each view that is marked as done."""
    folder = run_of(job).generated.folder
    out = {}
    for marker in (folder / "done_latent").glob("c.*.0"):
        view = int(marker.name.split(".")[1])
        status = (folder / "latent" / f"c.{view}.0.0.0").stat()
        out[view] = status.st_ino, status.st_mtime_ns
    return out


def workers_of(parent: int) -> list[int]:
    """Process ids of the local workers that belong to `parent`."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                line = (entry / "cmdline").read_bytes().split(b"\0")
            except OSError:
                continue
            if b"flows.workers.worker" in line and str(parent).encode() in line:
                found.append(int(entry.name))
    return sorted(found)


if __name__ == "__main__":
    from flows.errors import describe

    try:
        run_stages(Job.model_validate_json(Path(sys.argv[1]).read_text()), "sample", "decode")
    except Exception as error:
        print(describe(error) or repr(error), file=sys.stderr)
        sys.exit(1)
