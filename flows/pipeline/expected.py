"""How long the steps of a job will take and how much memory, said before they start."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterator, Sequence
from pathlib import Path

from flows.jobs.job import Job
from flows.pipeline.keys import Step
from flows.pipeline.working_size import PIXEL_BYTES
from schemas.errors import StoreError
from schemas.scene_store import SceneStore
from schemas.stages import StageRecord

#: Bytes of a process that has imported everything, and of each pixel of a photo while it is read (by two at a time).
BASE_BYTES, READ_BYTES = 0.6e9, 30
#: Earlier scenes in the same folder that are looked at.
SCENES = 20
#: Seconds for a unit of work (see `work_of`) on two cores of 2026, where there is no earlier timing in the folder.
#: Those that depend on the preset have its name too.
USUAL = {
    ("ingest", ""): 4e-8, ("poses", ""): 3.0, ("evaluate", ""): 6e-7,
    ("reconstruct", "tiny"): 8.0, ("reconstruct", "fast"): 80.0, ("reconstruct", "balanced"): 1200.0,
    ("render", "tiny"): 1e-5, ("render", "fast"): 3e-5, ("render", "balanced"): 1e-4,
}  # fmt: skip
OF_PRESET = ("reconstruct", "render")
#: What a record counts of a stage's work, "" where one counts as another.
COUNTED = {"ingest": "pixels_read", "poses": "views", "reconstruct": "", "render": "rays", "evaluate": "pixels"}


def work_of(job: Job, stage: str) -> float:
    """What a stage's time is about proportional to: pixels that are read, photos to place, rays, pixels compared; 1
    where only the preset counts."""
    capture = job.capture()
    width, height = capture.size(0)
    stored = width * height / (job.config.ingest.downscale or 1.0) ** 2
    test = len(job.split["test"]) if job.config.render.test_views else 0
    if stage == "ingest":
        return len(capture) * width * height
    if stage == "poses":
        return 0.0 if capture.cameras is not None and job.config.poses.estimate == "missing" else float(len(capture))
    if stage == "render":
        return stored * (test + (job.config.render.path_views if job.config.render.path != "none" else 0))
    return stored * test if stage == "evaluate" else 1.0


def expected(todo: Sequence[tuple[Job, Sequence[Step]]]) -> str:
    """A sentence on the time and memory that the steps of jobs of one scene will take; "" where nothing is known."""
    steps = {(step.stage, step.key): (job, step.stage) for job, some in todo for step in some}
    if not steps:
        return ""
    rates = earlier_rates(todo[0][0].out)
    seconds, unknown, own = 0.0, [], False
    for job, stage in steps.values():
        name = (stage, _kind(job, stage))
        rate = statistics.median(rates[name]) if name in rates else USUAL.get(name)
        own |= name in rates
        work = work_of(job, stage)
        if rate is not None:
            seconds += rate * work
        elif work:
            unknown.append(stage)
    if not seconds:
        return ""
    source = "earlier runs in this folder" if own else "what two CPU cores usually take"
    but = f", and what {', '.join(dict.fromkeys(unknown))} takes" if unknown else ""
    memory = expected_memory(todo[0][0], {stage for _, stage in steps.values()})
    return f"Expected, by {source}: {duration(seconds)}{but}; up to {memory / 1e9:.1f} GB of memory."


def expected_memory(job: Job, stages: set[str]) -> float:
    """Bytes: reading photos needs a few of them whole, reconstructing needs all at their stored size."""
    width, height = job.capture().size(0)
    read = READ_BYTES * width * height if "ingest" in stages else 0.0
    stored = len(job.capture()) * width * height / (job.config.ingest.downscale or 1.0) ** 2
    return BASE_BYTES + max(read, PIXEL_BYTES * stored if "reconstruct" in stages else 0.0)


def earlier_rates(out: Path) -> dict[tuple[str, str], list[float]]:
    """Seconds for a unit of work by stage and, where it counts, method and preset, of what is stored in a folder."""
    rates: dict[tuple[str, str], list[float]] = {}
    for job, records in _earlier(out):
        for record in records:
            unit = COUNTED[record.stage]
            work = record.work.get(unit, 0.0) if unit else 1.0
            if work and record.seconds:
                rates.setdefault((record.stage, _kind(job, record.stage)), []).append(record.seconds / work)
    return rates


def _earlier(out: Path) -> Iterator[tuple[Job, list[StageRecord]]]:
    for path in sorted(out.glob("*.zarr"))[:SCENES]:
        try:
            store = SceneStore.open(path)
            for name in store.runs():
                document = store.run(name).attrs.get("job")
                if document is not None:
                    job = Job.model_validate(document | {"out": str(out)})
                    found = [store.record(stage, name) for stage in COUNTED]
                    yield job, [record for record in found if record is not None]
        except (StoreError, ValueError):  # whatever is wrong there is said when it is used
            continue


def _kind(job: Job, stage: str) -> str:
    """The preset, with the method where it is another than zipnerf, of stages whose time depends on it."""
    if stage not in OF_PRESET:
        return ""
    settings = job.config.reconstruct
    return settings.preset if settings.method == "zipnerf" else f"{settings.method} {settings.preset}"


def duration(seconds: float) -> str:
    """So many seconds in words, not more exactly than it is known."""
    if seconds < 90:
        return f"about {max(10, 10 * round(seconds / 10))} seconds"
    if seconds < 5400:
        return f"about {math.ceil(seconds / 60)} minutes"
    return f"about {seconds / 3600:.1f} hours"
