"""Stage sample: groups of the plan -> latents of generated views, fanned out over workers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch

from flows.jobs import Job, Outcome
from flows.sampling.fan_out import fan_out
from flows.sampling.groups import Group, StoredPlan, view_keys
from flows.sampling.model import model_config, model_hash, sampler_config, sampler_settings, shared_model
from flows.sampling.shrinking import sample_at_most
from flows.sampling.work import Work, is_done
from schemas.scene_store import SceneStore

VERSION = 1


def inputs(job: Job) -> dict[str, Any]:
    """The model's weights, and the sampler it is used with."""
    return {"model": model_hash(job), "sampler": sampler_settings(job)}


def execute(job: Job, store: SceneStore, key: str) -> Outcome:
    """Write `generated/latent`, each view recorded in `done_latent` when it is complete; only missing ones are made."""
    work = sample_work(job, store, key)
    groups = [g for items in work.passes for g in items]
    totals = fan_out([work], job.config.execution, f"sample {job.scene_id} {job.run}")
    counts = {"views": sum(len(work.views[g]) for g in groups), "groups": len(groups)}
    return Outcome(counts | {"steps": sampler_settings(job)["steps"] * len(groups)} | totals.work(), totals.decisions)


def sample_work(job: Job, store: SceneStore, key: str) -> Work:
    """The groups that are to be sampled: anchors first, then all others. Makes room for the latents."""
    run = store.run(job.run)
    plan = StoredPlan(store, run, job.config.seed)
    shape = latent_shape(job)
    run.generated.create_array("latent", (len(plan), *shape))
    run.generated.create_array("done_latent", (len(plan), 32))
    targets = [group.targets for group in plan.groups]
    keys = view_keys(key, len(plan))
    return Work(job, "sample", key, run.generated, "done_latent", "latent", keys, plan.passes(), targets)


def latent_shape(job: Job) -> tuple[int, int, int]:
    """(C, h, w) of the model's latents."""
    unet = model_config(job).unet
    return unet.latent_channels, unet.latent_size, unet.latent_size


def work(job: Job, store: SceneStore, key: str, items: Sequence[int]) -> None:
    """A worker's share: sample the groups `items`, in order, and store the views of each as soon as they are there."""
    run = store.run(job.run)
    plan = StoredPlan(store, run, job.config.seed)
    keys = view_keys(key, len(plan))
    model, config = shared_model(job), sampler_config(job)
    targets = [view for g in items for view in plan.groups[g].targets]
    missing = {v for v in targets if not is_done(run.generated, "done_latent", v, keys[v], "latent")}
    groups = [plan.groups[g] for g in items if missing.intersection(plan.groups[g].targets)]
    at_once = job.config.execution.groups_at_once
    for chunk in alike(groups, at_once):
        tensors = network_inputs(plan, chunk, latent_shape(job))
        latents, at_once = sample_at_most(at_once, model, tensors, config)
        for group, made in zip(chunk, latents.cpu(), strict=True):
            new = [i for i, view in enumerate(group.targets) if view in missing]
            views = [group.targets[i] for i in new]
            run.generated.write_views("latent", made[new].half().numpy(), views)
            run.generated.mark_done("done_latent", [keys[v] for v in views], views)


def alike(groups: Sequence[Group], at_once: int) -> list[list[Group]]:
    """Successive runs of at most `at_once` groups with equal numbers of conditioning and target views."""
    chunks: list[list[Group]] = []
    last = None
    for group in groups:
        shape = len(group.conditions), len(group.targets)
        if shape == last and len(chunks[-1]) < at_once:
            chunks[-1].append(group)
        else:
            chunks.append([group])
        last = shape
    return chunks


def network_inputs(
    plan: StoredPlan, groups: Sequence[Group], shape: tuple[int, int, int]
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """For groups of one shape: given latents [G, M, C, h, w], raymaps [G, M+N, 6, h, w], noise [G, N, C, h, w]."""
    return (
        torch.stack([plan.condition_latents(g) for g in groups]),
        torch.stack([plan.raymaps(g, shape[-1]) for g in groups]),
        torch.stack([plan.noise(g, shape) for g in groups]),
    )
