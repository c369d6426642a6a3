"""Stage plan: the training views' cameras -> the cameras to generate, their groups, and what each is conditioned on."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch

from cat3d_core.cameras import Cameras
from cat3d_core.plan import Plan, PlanConfig, make_plan
from flows.generation.open import generator_spec
from flows.generation.plan import write_plan
from flows.jobs.access import read_cameras, views_with_role
from flows.jobs.job import Job, Outcome
from flows.jobs.stage import Stage, generates, settings_of
from schemas.decisions import chosen, skipped
from schemas.documents import write_bytes
from schemas.errors import ConfigError
from schemas.scene_store import SceneStore

#: `skip.covered_path`: how much of what the path's views see captured views must show from nearby directions.
COVERED_SHARE = 0.9


def inputs(job: Job, keys: Mapping[str, str]) -> dict[str, Any]:
    """The training views, what the generator wants (the side of its images in pixels, the views of a group), and what
    may be skipped."""
    spec, skip = generator_spec(job), job.config.skip
    layout = {} if spec.layout == "groups" else {"layout": spec.layout}
    return layout | {
        "train": job.view_names("train"),
        "image_size": planned_size(job),
        "views": spec.views,
        "drop_by_coverage": skip.coverage,
        "covered_share": COVERED_SHARE if skip.covered_path else None,
    }


def execute(job: Job, store: SceneStore, key: str) -> Outcome:
    """Write `plan/` and its drawing `plan.png`."""
    run = store.run(job.run)
    train = views_with_role(store, run, "train")
    plan = planned(job, store, train)
    write_plan(run.plan, plan.among(train, store.captured.shape("size")[0]))
    from flows.media.plan_drawing import (
        draw_plan,  # matplotlib: a second, which asking what is to do should not cost
    )

    job.pictures.mkdir(parents=True, exist_ok=True)
    picture = draw_plan(read_cameras(store.captured, train), plan, _points(store), f"{job.scene_id} {job.run}")
    write_bytes(job.pictures / "plan.png", picture)
    anchors = sum(len(group.targets) for group in plan.groups if group.anchors)
    summary = f"{len(plan)} views of the trajectory {plan.recipe} in {len(plan.groups)} groups"
    decisions = [chosen(f"{summary}, {anchors} of them anchors." if anchors else f"{summary}.")]
    decisions += map(chosen, plan.reasons)
    if plan.dropped:
        text = "Views that add nothing to the coverage of the scene are not generated."
        decisions.append(skipped(text, "coverage", views=plan.dropped))
    if not plan.needed:
        text = "No view is generated: captured views show what they would from nearly the same directions."
        decisions.append(skipped(text, "covered_path", views=len(plan)))
    return Outcome({"views": len(plan), "groups": len(plan.groups)}, decisions)


def planned(job: Job, store: SceneStore, train: list[int]) -> Plan:
    """The plan from these captured views; its captured view i is train[i].

    Raises ConfigError for settings that contradict each other or the generator.
    """
    captured = read_cameras(store.captured, train)
    bounds = torch.from_numpy(store.captured.read("depth_bounds", train)) if "depth_bounds" in store.captured else None
    try:
        return make_plan(captured, core_config(job, captured), _points(store), bounds, job.config.seed)
    except ValueError as error:
        raise ConfigError(f"The settings of the plan don't work for {job.scene_id}: {error}") from None


def planned_size(job: Job) -> int:
    """Side of the planned views in pixels: the generator's, unless another was asked for."""
    return job.config.plan.image_size or generator_spec(job).image_size[0]


def core_config(job: Job, captured: Cameras) -> PlanConfig:
    """The core's settings for the run's; conditioning views and targets together are what the generator takes."""
    settings, spec, skip = job.config.plan, generator_spec(job), job.config.skip
    if spec.layout == "windows":
        for name in ("anchors", "condition_views", "group_size"):
            if getattr(settings, name) is not None:
                raise ConfigError(
                    f"plan.{name} is set, but this generator's windows of {spec.views} views follow from "
                    "the number of photos and of views: leave it out."
                )
    conditions = settings.condition_views or max((n for n in spec.given if n <= 3), default=min(spec.given))
    if conditions not in spec.given:
        raise ConfigError(
            f"plan.condition_views is {conditions}, but the generator takes {', '.join(map(str, spec.given))} of them."
        )
    if (total := conditions + (settings.group_size or 1)) > spec.views:
        raise ConfigError(
            f"plan.condition_views and plan.group_size come to {total} views, but the model takes {spec.views} at "
            "once: ask for fewer."
        )
    not_square = bool((captured.size[:, 0] != captured.size[:, 1]).any())
    return PlanConfig(
        trajectory=settings.trajectory,
        views=spec.views,
        count=settings.views,
        scales=settings.scales,
        sides=settings.sides,
        heights=settings.heights,
        forwards=settings.forwards,
        anchors=settings.anchors,
        conditions=conditions,
        group_size=settings.group_size,
        keep_captured=settings.always_captured,
        samples="both" if settings.wide and not_square else "square",
        image_size=planned_size(job),
        drop_by_coverage=skip.coverage,
        covered_share=COVERED_SHARE if skip.covered_path else None,
        layout=spec.layout,
    )


def _points(store: SceneStore) -> torch.Tensor | None:
    return torch.from_numpy(store.captured.read("points")) if "points" in store.captured else None


STAGE = Stage(
    "plan",
    execute,
    version=1,
    reads=("poses",),
    settings=settings_of("plan", "seed", without=("image_size", "window")),
    inputs=inputs,
    wanted=generates,
)
