"""Stage decode: latents of generated views -> images, fanned out over workers; may be far behind the sampling."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from flows.errors import InputError
from flows.generation.groups import view_keys
from flows.generation.hints import explained_views
from flows.generation.imported import Imported, imported
from flows.generation.open import generator_spec, open_generator
from flows.generation.views import finished
from flows.jobs.job import Job, Outcome
from flows.jobs.needs import Needs
from flows.jobs.stage import Stage, generates
from flows.media.images import to_uint8
from flows.workers.fan_out import fan_out
from flows.workers.work import ViewMarks, ViewWork, is_done
from schemas.decisions import chosen, skipped
from schemas.scene_store import SceneStore

NEEDS = Needs(gpu=True, memory_gb=1.5)


def inputs(job: Job, keys: Mapping[str, str]) -> dict[str, Any]:
    """The generator, and whether its views are put together with what photos show; or the pictures that were imported
    instead, with the plan that they are of."""
    if found := imported(job):
        return {"imported": found.sha256, "plan key": keys["plan"]}
    return {"model": generator_spec(job).identity} | ({"hints": True} if job.hinted else {})


def execute(job: Job, store: SceneStore, key: str) -> Outcome:
    """Write `generated/image`, each view recorded in `done_image` when it is complete; only missing ones are made, and
    none of those that were left out of the sampling. Imported ones are there already."""
    if found := imported(job):
        return take_over(job, store, key, found)
    generated = store.run(job.run).generated
    views, (width, height) = generated.shape("latent")[0], generator_spec(job).image_size
    generated.create_array("image", (views, height, width, 3))
    generated.create_array("done_image", (views, 32))
    if job.hinted:
        generated.create_array("confidence", (views, height, width))
    explained = explained_views(job, store.run(job.run))
    wanted = np.flatnonzero(generated.read("done_latent").any(-1) | explained).tolist()
    left_out = sorted(set(range(views)) - set(wanted))
    generated.mark_skipped("done_image", left_out)
    text = f"Skipped decoding {len(left_out)} of {views} views: they were not sampled."
    decisions = [skipped(text, views=len(left_out))] if left_out else []
    each = [[view] for view in range(views)]
    marks = ViewMarks(generated, "done_image", "image", view_keys(key, views))
    share = ViewWork(job, "decode", key, NEEDS, open_generator, work, marks, [wanted], each)
    missing = len(share.passes[0])
    label = f"decode {job.scene_id} {job.run}"
    totals = fan_out([share], job.config.execution, label, here=job.config.skip.workers)
    counts = {"views": missing, "evaluations": missing} | totals.work()
    return Outcome(counts, decisions + totals.decisions, totals.usage, totals.waited)


def take_over(job: Job, store: SceneStore, key: str, found: Imported) -> Outcome:
    """Imported views become the run's generated ones. Raises InputError where they are of another plan."""
    run, plan = store.run(job.run), store.record("plan", job.run)
    if plan is None or plan.key != found.plan:
        raise InputError(
            f"The plan of {job.run} has changed since views were imported for it from {found.folder}: make them again "
            "(`cat3d export --what plan`, `cat3d import-views`), or generate them here (`cat3d import-views --forget`)."
        )
    count = run.generated.shape("image")[0]
    keys = view_keys(key, count)
    run.generated.remove("confidence")  # of views that were generated here before
    run.generated.create_array("done_image", (count, 32))
    run.generated.mark_done("done_image", [keys[view] for view in found.views], found.views)
    run.generated.mark_skipped("done_image", sorted(set(range(count)) - set(found.views)))
    return Outcome({"views": len(found.views)}, [chosen(str(found))])


def work(job: Job, store: SceneStore, key: str, items: Sequence[int]) -> None:
    """A worker's share: decode the views `items`, one at a time."""
    run = store.run(job.run)
    generated = run.generated
    generator = open_generator(job)
    keys = view_keys(key, generated.shape("latent")[0])
    explained = explained_views(job, run)
    for view in items:
        if is_done(generated, "done_image", view, keys[view], "image"):
            continue
        image, trust = finished(job, generator, run, view, bool(explained[view]))
        if trust is not None:
            generated.write_views("confidence", trust.half().numpy()[None], [view])
        generated.write_views("image", to_uint8(image)[None], [view])
        generated.mark_done("done_image", [keys[view]], [view])


STAGE = Stage(
    "decode",
    execute,
    version=1,
    reads=("sample",),
    inputs=inputs,
    wanted=generates,
    needs=NEEDS,
    spreads=True,
)
