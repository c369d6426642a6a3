"""Stage match: photos and planned cameras -> what the photos show of each planned view, by a plane sweep."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from cat3d_core.matching.hint import Hint, hint, observe
from cat3d_core.matching.network import SweepNetwork
from cat3d_core.sample_sets import KINDS
from flows.generation.groups import view_keys
from flows.generation.hints import OWN, UNEXPLAINED_SHARE, open_sweep, read_hint, sweep_identity
from flows.generation.imported import samples
from flows.generation.photo_depths import photos
from flows.generation.plan import read_plan
from flows.jobs.access import views_with_role
from flows.jobs.device import cpu_threads
from flows.jobs.job import Job, Outcome
from flows.jobs.needs import Needs
from flows.jobs.stage import Stage
from flows.media.images import to_uint8
from flows.progress import meter
from schemas.decisions import chosen, skipped
from schemas.scene_store import SceneStore, Section

#: Views that are worked on together, and stored together.
AT_ONCE = 8
MAPS = ("confidence", "inverse_depth", "spread", "seen")
#: Largest number of the maps' type; inverse depths beyond it do not occur.
LARGEST = float(np.finfo(np.float16).max)


def inputs(job: Job, keys: Mapping[str, str]) -> dict[str, Any]:
    """The plane sweep, the photos it looks at, and whether it says which views need no sampling."""
    return {"sweep": sweep_identity(job), "train": job.view_names("train"), "explained": job.config.skip.explained}


def execute(job: Job, store: SceneStore, key: str) -> Outcome:
    """Write `hints/`, each view recorded in `done` when it is complete; only missing ones are made."""
    run = store.run(job.run)
    plan = read_plan(run.plan, store.captured.shape("size")[0])
    train = views_with_role(store, run, "train")
    section = run.section("hints", create=True)
    count, side = len(plan), int(plan.cameras.size[0, 0])
    section.create_array("colour", (count, side, side, 3))
    for name in MAPS:
        section.create_array(name, (count, side, side))
    section.create_array("done", (count, 32))
    keys = view_keys(key, count)
    todo = set(np.flatnonzero(~section.done("done", keys, ("colour", *MAPS))).tolist()) if plan.needed else set()
    made = len(todo)
    if not plan.needed:
        section.mark_skipped("done", range(count))
    with meter(f"match {job.scene_id} {job.run}", made) as progress, cpu_threads(job.config.execution.threads):
        for kind in KINDS:
            views = sorted(todo.intersection(v for g in plan.groups if g.kind == kind for v in g.targets))
            if not views:
                continue
            network = open_sweep(job)
            observed = observe(network, *photos(store, train, kind, side))
            for first in range(0, len(views), AT_ONCE):
                some = views[first : first + AT_ONCE]
                _store(section, some, hint(network, observed, plan.cameras[some]), keys)
                progress.advance(len(some))
    explained = np.zeros(count, bool)
    if plan.needed and job.config.skip.explained:
        network = open_sweep(job)
        for group in plan.groups:  # sampled whole or not at all, and anchors always: others need their latents
            shown = not group.anchors and all(shows(network, read_hint(run, v).confidence) for v in group.targets)
            explained[list(group.targets)] = shown
    section.write("explained", explained)
    decisions = []
    if plan.needed:
        confidence = section.read("confidence").astype(np.float32)
        decisions.append(
            chosen(f"The photos show {float((confidence > 0.5).mean()):.0%} of the planned views' pixels.")
        )
    if explained.any():
        text = (
            f"{int(explained.sum())} of {count} planned views are shown wholly by the photos: nothing is sampled there."
        )
        decisions.append(skipped(text, "explained", views=int(explained.sum())))
    return Outcome({"views": made}, decisions)


def shows(network: SweepNetwork, confidence: torch.Tensor) -> bool:
    """Whether a view (H, W) is wholly what photos show, once it is put together with a sample."""
    own = network.composite.share(confidence) >= OWN
    return float((~own).float().mean()) <= UNEXPLAINED_SHARE


def _store(section: Section, views: list[int], found: Hint, keys: list[str]) -> None:
    """Data first, then the marks."""
    section.write_views("colour", to_uint8(found.colour.cpu().permute(0, 2, 3, 1)), views)
    for name in MAPS:
        values = getattr(found, name).clamp(0, LARGEST).cpu().half().numpy()
        section.write_views(name, values, views)
    section.mark_done("done", [keys[view] for view in views], views)


def wanted(job: Job) -> bool:
    """Where hints are used, and views are generated here and not imported."""
    return job.hinted and samples(job)


STAGE = Stage(
    "match", execute, version=1, reads=("plan",), inputs=inputs, wanted=wanted, needs=Needs(gpu=True, memory_gb=1.0)
)
