"""The smallest run that has every stage, done in this process without a Prefect server, and what it amounts to."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np

from flows.jobs.job import Job
from flows.jobs.request import Request, make_config
from flows.pipeline.keys import pending, stages_of
from flows.pipeline.runner import execute_stage, opened, prepare_run
from flows.reporting.report import write_report
from schemas.documents import nodes
from schemas.scene_store import SceneStore
from schemas.section import Section
from schemas.tables import read_rows
from schemas.verify import verify
from tests.flows.workers.scene import random_model

SOURCE = "procedural:dtu/3?views=4&width=16&height=12"
REPORT = "report"
SETTINGS = [
    "method=cat3d", "sample.steps=1", "sample.solver=ddim", "sample.guidance=1", "plan.views=2", "execution.threads=1",
    "skip={coverage: false, covered_path: false}", "evaluate.lpips=false", "render.path=none",
    "reconstruct.overrides={iterations: 2, batch_rays: 32, samples: [4, 4], grid_max: [16, 32], grid_features: [1, 1], "
    "interlevel_blur: [0.03], grid_log2_table: 6, warmup_iterations: 1, lpips_weight: 0.0}",
]  # fmt: skip


def model(folder: Path) -> Path:
    """A model's file with random weights."""
    return random_model(folder / "tiny.safetensors")


def tiny_job(out: Path, checkpoint: Path) -> Job:
    """Three photos of 16 x 12 pixels and two generated views."""
    config = make_config({}, None, [*SETTINGS, f"sample.checkpoint={checkpoint}"])
    return Request(SOURCE, out, ("3",), config).jobs()[0]


def stages(job: Job) -> list[str]:
    """Names of the job's stages, in order."""
    return [stage.name for stage in stages_of(job)]


def advance(job: Job, stage: str) -> None:
    """Do what is missing up to `stage`, and the report after the last one, as `cat3d run` does."""
    if stage == REPORT:
        write_report(job.out)
        return
    wanted = stages(job)[: stages(job).index(stage) + 1]
    with opened(job):
        prepare_run(job)
        for step in pending(job):
            if step.stage in wanted:
                execute_stage(job, step)


def problems(job: Job) -> list[str]:
    """What `cat3d inspect --verify` says of the store; nothing where there is none yet."""
    if not job.store_path.exists():
        return []
    return [problem.message for problem in verify(SceneStore.open(job.store_path))]


def digest(job: Job) -> str:
    """Of every array and metric of the run, and of its pictures: all that must not depend on interruptions."""
    found = hashlib.sha256()
    store = SceneStore.open(job.store_path)
    for path, kind in nodes(store.folder):
        if kind != "array":
            continue
        parent, _, name = path.rpartition("/")
        values = Section(store.root, parent, False).read(name)
        if path.endswith("field/record"):
            values = np.delete(values, 1, axis=1)  # the column of seconds
        found.update(path.encode())
        found.update(repr(values.tolist()).encode() if values.dtype.kind in "OT" else values.tobytes())
    for row in read_rows(job.out / "metrics").to_pylist() if (job.out / "metrics").exists() else []:
        found.update(repr(sorted(row.items())).encode())
    for picture in sorted(job.pictures.glob("*.png")):
        found.update(picture.name.encode() + picture.read_bytes())
    return found.hexdigest()
