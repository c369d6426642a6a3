"""What is to be done for one scene and split, and which of its stages are not done yet.

A stage's content key covers the keys of the stages it reads, its own inputs and configuration, and its code version.
Keys follow from the inputs alone, so what is stale is known before anything runs.
"""

from __future__ import annotations

import hashlib
import importlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from pydantic import BaseModel, ConfigDict

from flows.errors import InputError
from flows.readers.base import Capture, read_capture
from schemas.config import RunConfig
from schemas.content_key import array_digest, content_key
from schemas.errors import MissingError
from schemas.layout import SCENE_STAGES, STAGES
from schemas.scene_store import SceneStore

#: Stages that only runs with generated views have.
GENERATIVE_STAGES = ("plan", "encode", "sample", "decode")


class Job(BaseModel):
    """One run of one scene: where it comes from, which views train, how, and where results go. JSON in, JSON out."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    source: str
    reader: str = "auto"
    image_folder: str | None = None
    out: Path
    scene_id: str
    dataset: str
    config: RunConfig
    store: Path | None = None
    results: Path | None = None

    @property
    def store_path(self) -> Path:
        """Where the scene's store is; `store` overrides it while a scene is reprocessed beside its old results."""
        return self.store or self.out / f"{self.scene_id}.zarr"

    @property
    def label(self) -> str:
        """The method's name, or that of the ablation."""
        return self.config.label or self.config.method

    @property
    def run(self) -> str:
        """Name of the run inside the store, e.g. "v3-zipnerf"; seeds other than 0 are named too."""
        seed = f"-s{self.config.seed}" if self.config.seed else ""
        return f"v{self.config.split}-{self.label}{seed}"

    @property
    def results_path(self) -> Path:
        """Folder of metrics and pictures; `results` overrides it as `store` does the store."""
        return self.results or self.out

    @property
    def pictures(self) -> Path:
        """Folder of the run's pictures, videos and exports."""
        return self.results_path / self.scene_id / self.run

    @property
    def stages(self) -> tuple[str, ...]:
        """The stages of this run, in order."""
        if self.config.method == "zipnerf":
            return tuple(s for s in STAGES if s not in GENERATIVE_STAGES)
        return tuple(STAGES)

    def capture(self) -> Capture:
        """The scene as its reader finds it now."""
        return read_capture(self.source, self.reader, self.image_folder)

    def split(self, capture: Capture) -> dict[str, list[int]]:
        """Training and test indices of this run. Raises InputError when the scene has no such split."""
        if self.config.split not in capture.splits:
            known = ", ".join(capture.splits) or "none"
            raise InputError(
                f"Scene {self.scene_id} has no split for {self.config.split} views (its splits: {known}); "
                "choose one of those with --views."
            )
        return capture.splits[self.config.split]


class Outcome(NamedTuple):
    """What a stage did: `work` counts (views, rays, ...); `decisions` are sentences on what was chosen or skipped."""

    work: dict[str, float] = {}
    decisions: list[str] = []


@dataclass(frozen=True)
class Step:
    """One stage of one job with everything its content key is made of."""

    stage: str
    key: str
    inputs: dict[str, Any]
    config: dict[str, Any]
    version: str
    why: str = field(default="", compare=False)


def make_jobs(
    source: str,
    out: Path,
    views: Sequence[str],
    config: RunConfig,
    reader: str = "auto",
    image_folder: str | None = None,
) -> tuple[Capture, list[Job]]:
    """Read the scene and make one job per split. Raises InputError for bad input or an unknown split."""
    capture = read_capture(source, reader, image_folder)
    job = Job(
        source=str(source),
        reader=reader,
        image_folder=image_folder,
        out=out,
        scene_id=capture.scene_id,
        dataset=capture.dataset,
        config=config,
    )
    jobs = []
    for split in views:
        one = job.model_copy(update={"config": config.model_copy(update={"split": str(split)})})
        few = len(one.split(capture)["train"]) == 1
        if config.method == "auto":
            one = one.model_copy(
                update={"config": one.config.model_copy(update={"method": "cat3d" if few else "zipnerf"})}
            )
        jobs.append(one)
    return capture, jobs


def expected_steps(job: Job, capture: Capture, digests: dict[str, Any] | None = None) -> dict[str, Step]:
    """Every stage of the job with the key it must have, by stage name.

    digests: `capture_digests(capture)`, to compute it once for several jobs of one scene.
    """
    digests = digests or capture_digests(capture)
    split = job.split(capture)
    roles = {role: [capture.names[i] for i in ids] for role, ids in split.items()}
    external: dict[str, dict[str, Any]] = {
        "ingest": {"images": digests["images"], "lens": digests["lens"]},
        "poses": {"cameras": digests["cameras"]},
        "plan": {"train": roles["train"]},
        "encode": {},
        "sample": {},
        "decode": {},
        "reconstruct": {"train": roles["train"]},
        "render": {"test": roles["test"]},
        "evaluate": {},
    }
    steps: dict[str, Step] = {}
    for stage in job.stages:
        inputs = external[stage] | {f"{s} key": steps[s].key for s in STAGES[stage] if s in steps}
        if stage == "evaluate":  # of the renders it reads those of held-out views alone: a new path changes no number
            field, test = steps["reconstruct"].key, {"views": roles["test"], "rendered": job.config.render.test_views}
            inputs["render key"] = content_key(field=field, test=test, version=steps["render"].version)
        module = importlib.import_module(f"flows.stages.{stage}")
        if hasattr(module, "inputs"):
            inputs |= module.inputs(job)
        config = stage_config(job.config, stage)
        version = str(module.VERSION)
        key = content_key(stage=stage, inputs=inputs, config=config, version=version)
        steps[stage] = Step(stage, key, inputs, config, version)
    return steps


def stage_config(config: RunConfig, stage: str) -> dict[str, Any]:
    """The settings that can change the stage's result, as plain JSON values."""
    document = config.model_dump(mode="json")
    document["sample"].pop("checkpoint")  # the hash of its weights is an input of the stages that use them
    own = {} if stage in ("encode", "decode") else document[stage]
    if stage in ("plan", "poses", "sample", "reconstruct"):
        own["seed"] = document["seed"]
    return own


def pending(job: Job, steps: dict[str, Step]) -> list[Step]:
    """The steps whose record is missing or has another key, each with the reason."""
    try:
        store = SceneStore.open(job.store_path)
    except MissingError:
        return [Step(s.stage, s.key, s.inputs, s.config, s.version, "not done yet") for s in steps.values()]
    out = []
    for step in steps.values():
        why = stale_reason(store, job.run, step)
        if why:
            out.append(Step(step.stage, step.key, step.inputs, step.config, step.version, why))
    if not any(step.stage == "sample" for step in out) and store.record("encode") is not None:
        # Runs with another model's encoder share the scene: its latents are of whoever sampled last, and no other stage
        # reads them.
        out = [step for step in out if step.stage != "encode"]
    return out


def stale_reason(store: SceneStore, run: str, step: Step) -> str:
    """Why the step must run (a phrase), or "" when its stored result is the one that is wanted."""
    if step.stage not in SCENE_STAGES and run not in store.runs():
        return "not done yet"
    record = store.record(step.stage, run)
    if record is None:
        return "not done yet"
    if record.key == step.key:
        return ""
    changes = []
    if record.code_version != step.version:
        changes.append(f"code version {record.code_version} is now {step.version}")
    changes += [f"{n} changed" for n in _changed(record.inputs, step.inputs)]
    changes += [f"setting {n} changed" for n in _changed(record.config, step.config)]
    return "; ".join(changes) or "its key changed"


def _changed(old: dict[str, Any], new: dict[str, Any]) -> list[str]:
    names = sorted(set(old) | set(new))
    return [n.removesuffix(" key") for n in names if content_key(v=old.get(n)) != content_key(v=new.get(n))]


def capture_digests(capture: Capture) -> dict[str, Any]:
    """Digests of what a capture brings: "images" {name: sha256}, "lens" (intrinsics, distortion, masks), "cameras"."""
    if capture.image_digests is not None:
        images = dict(zip(capture.names, capture.image_digests))
    elif capture.images is not None:
        images = {name: array_digest(image) for name, image in zip(capture.names, capture.images)}
    else:
        images = {name: file_sha256(path) for name, path in zip(capture.names, capture.paths)}
    masks = [None if m is None else file_sha256(m) for m in capture.masks]
    cameras = capture.cameras

    def digest(tensor: Any) -> str | None:
        return None if tensor is None else array_digest(tensor.numpy())

    return {
        "images": images,
        "lens": {
            "intrinsics": digest(cameras.intrinsics) if cameras else None,
            "distortion": digest(capture.distortion),
            "masks": masks,
        },
        "cameras": {
            "poses": digest(cameras.world_from_camera) if cameras else None,
            "points": digest(capture.points),
            "depth_bounds": digest(capture.depth_bounds),
        },
    }


def file_sha256(path: Path) -> str:
    """sha256 of a file's bytes, hexadecimal."""
    with open(path, "rb") as f:
        return hashlib.file_digest(f, "sha256").hexdigest()
