"""Stage plan: the training views' cameras -> the cameras to generate, their groups, and what each is conditioned on."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from cat3d_core.cameras import Cameras
from cat3d_core.plan import Plan, PlanConfig, make_plan
from cat3d_core.sample_sets import KINDS
from flows.generation.model import model_config
from flows.jobs.access import read_cameras, views_with_role, write_cameras
from flows.jobs.job import Job, Outcome
from flows.jobs.stage import Stage, generates, settings_of
from schemas.decisions import chosen
from schemas.errors import ConfigError
from schemas.scene_store import Run, SceneStore

#: `skip.covered_path`: how much of what the path's views see captured views must show from nearby directions.
COVERED_SHARE = 0.9


def inputs(job: Job, keys: Mapping[str, str]) -> dict[str, Any]:
    """The training views, what the model wants (the side of its images in pixels, the views of a group), and what may
    be skipped."""
    model, skip = model_config(job), job.config.skip
    return {
        "train": job.view_names("train"),
        "image_size": model.image_size,
        "views": model.views,
        "drop_by_coverage": skip.coverage,
        "covered_share": COVERED_SHARE if skip.covered_path else None,
    }


def execute(job: Job, store: SceneStore, key: str) -> Outcome:
    """Write `plan/` and its drawing `plan.png`."""
    run = store.run(job.run)
    plan, train = plan_run(job, store, run)
    write_plan(run, plan, train, store.captured.shape("size")[0])
    from flows.media.plan_drawing import (
        draw_plan,  # matplotlib: a second, which asking what is to do should not cost
    )

    job.pictures.mkdir(parents=True, exist_ok=True)
    picture = draw_plan(read_cameras(store.captured, train), plan, _points(store), f"{job.scene_id} {job.run}")
    (job.pictures / "plan.png").write_bytes(picture)
    anchors = int(plan.anchor.sum())
    summary = f"{len(plan)} views of the trajectory {plan.recipe} in {len(plan.group_views)} groups"
    decisions = [chosen(f"{summary}, {anchors} of them anchors." if anchors else f"{summary}.")]
    decisions += map(chosen, plan.reasons)
    return Outcome({"views": len(plan), "groups": len(plan.group_views)}, decisions)


def plan_run(job: Job, store: SceneStore, run: Run) -> tuple[Plan, list[int]]:
    """The plan of a run, and its training views: captured view train[i] is the plan's captured view i.

    Raises ConfigError for settings that contradict each other or the model.
    """
    train = views_with_role(store, run, "train")
    captured = read_cameras(store.captured, train)
    bounds = torch.from_numpy(store.captured.read("depth_bounds", train)) if "depth_bounds" in store.captured else None
    try:
        return make_plan(captured, core_config(job, captured), _points(store), bounds, job.config.seed), train
    except ValueError as error:
        raise ConfigError(f"The settings of the plan don't work for {job.scene_id}: {error}") from None


def core_config(job: Job, captured: Cameras) -> PlanConfig:
    """The core's settings for the run's; conditioning views and targets together are what the model was trained for."""
    settings, model, skip = job.config.plan, model_config(job), job.config.skip
    conditions = settings.condition_views or min(3, model.views - 1)
    group_size = settings.group_size
    if group_size is None and model.views != 8:
        group_size = model.views - conditions
    if conditions + (group_size or 1) > model.views:
        raise ConfigError(
            f"plan.condition_views and plan.group_size come to {conditions + (group_size or 1)} views, but the model "
            f"takes {model.views} at once: ask for fewer."
        )
    not_square = bool((captured.size[:, 0] != captured.size[:, 1]).any())
    return PlanConfig(
        trajectory=settings.trajectory,
        count=settings.views,
        scales=settings.scales,
        sides=settings.sides,
        heights=settings.heights,
        forwards=settings.forwards,
        anchors=settings.anchors,
        conditions=conditions,
        group_size=group_size,
        keep_captured=settings.always_captured,
        samples="both" if settings.wide and not_square else "square",
        image_size=model.image_size,
        drop_by_coverage=skip.coverage,
        covered_share=COVERED_SHARE if skip.covered_path else None,
    )


def write_plan(run: Run, plan: Plan, train: list[int], captured_count: int) -> None:
    """Write the plan's arrays. The plan counts the training views it was given; the store counts all captured views."""
    section = run.plan
    write_cameras(section, plan.cameras)
    condition = plan.condition.numpy()
    to_store = np.array(train)
    is_captured = (condition >= 0) & (condition < plan.captured_count)
    is_planned = condition >= plan.captured_count
    stored = condition.copy()
    stored[is_captured] = to_store[condition[is_captured]]
    stored[is_planned] += captured_count - plan.captured_count
    arrays = {
        "condition": stored,
        "group": plan.group,
        "order": plan.order_in_group,
        "anchor": plan.anchor,
        "path": plan.path,
        "pose": plan.pose,
        "sample_kind": plan.sample_kind.numpy().astype(np.uint8),
        "window": plan.window,
        "group_views": plan.group_views,
        "group_valid": plan.group_valid,
        "group_targets": plan.group_targets,
    }
    for name, values in arrays.items():
        values = np.asarray(values)
        section.write(name, values.astype(np.int32) if values.dtype == np.int64 else values)
    section.set_attrs(
        recipe=plan.recipe,
        reasons=plan.reasons,
        needed=plan.needed,
        image_size=int(plan.cameras.size[0, 0]),
        kinds=[KINDS[k] for k in sorted(set(plan.sample_kind.tolist()))],
        captured_coverage=plan.captured_coverage,
        plan_coverage=plan.plan_coverage,
    )


def _points(store: SceneStore) -> torch.Tensor | None:
    return torch.from_numpy(store.captured.read("points")) if "points" in store.captured else None


STAGE = Stage(
    "plan", execute, version=1, reads=("poses",), settings=settings_of("plan", "seed"), inputs=inputs, wanted=generates
)
