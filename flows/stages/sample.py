"""Stage sample: groups of the plan -> latents of generated views, fanned out over workers."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch

from cat3d_core.diffusion import SamplerConfig, Schedule, count_flops
from cat3d_core.diffusion.sampler import evaluations
from flows.generation.groups import Group, StoredPlan, view_keys
from flows.generation.model import model_config, model_hash, sampler_config, sampler_settings, shared_model
from flows.generation.rounds import OneRound, Rounds
from flows.generation.shrinking import sample_at_most
from flows.jobs.job import Job, Outcome
from flows.jobs.stage import Stage, generates, settings_of
from flows.workers.fan_out import Totals, fan_out
from flows.workers.work import Work, is_done
from schemas.decisions import Decision, chosen, skipped
from schemas.scene_store import SceneStore

#: `skip.near_steps`: mean pose distance (scene distances, about radians of turning) from a group's views to the nearest
#: captured view below which the group takes half of the steps.
NEAR = 0.25


def inputs(job: Job, keys: Mapping[str, str]) -> dict[str, Any]:
    """The model's weights, the sampler it is used with, and how the views are chosen."""
    return {"model": model_hash(job), "sampler": sampler_settings(job), "rounds": job.config.skip.rounds}


def execute(job: Job, store: SceneStore, key: str) -> Outcome:
    """Write `generated/latent`, each view recorded in `done_latent` when it is complete; only missing ones are made.

    Views that the scene doesn't need are recorded there as left out on purpose.
    """
    run = store.run(job.run)
    plan = StoredPlan(store, run, job.config.seed)
    rounds = Rounds(job, store, plan, sampling_flops(job, plan)) if job.config.skip.rounds else OneRound(plan)
    totals, groups, spared = Totals(), [], set(range(len(plan.groups)))
    for passes in rounds:
        spared -= {g for items in passes for g in items}
        share = sample_work(job, store, key, passes)
        groups += [g for items in share.passes for g in items]
        label = f"sample {job.scene_id} {job.run}"
        totals += fan_out([share], job.config.execution, label, here=job.config.skip.workers)
    made = {view for g in rounds.kept for view in plan.groups[g].targets}
    left_out = sorted(set(range(len(plan))) - made)
    run.generated.mark_skipped("done_latent", left_out)
    decisions = []
    if left_out:
        saved = sum(group_evaluations(job, plan.groups[g], group_sampler(job, plan, plan.groups[g])) for g in spared)
        text = f"{len(left_out)} of {len(plan)} planned views were left out; {saved} network evaluations were saved."
        switch = "rounds" if plan.needed else "covered_path"
        decisions.append(skipped(text, switch, views=len(left_out), evaluations=saved))
    decisions += rounds.decisions + sampler_decisions(job, plan, rounds.kept) + totals.decisions
    configs = [group_sampler(job, plan, plan.groups[g]) for g in groups]
    counts = {"views": sum(len(plan.groups[g].targets) for g in groups), "groups": len(groups)}
    spent = sum(group_evaluations(job, plan.groups[g], c) for g, c in zip(groups, configs, strict=True))
    counts |= {"steps": sum(c.steps for c in configs), "evaluations": spent}
    return Outcome(counts | totals.work(), decisions)


def sample_work(job: Job, store: SceneStore, key: str, passes: Sequence[Sequence[int]] | None = None) -> Work:
    """The groups that are to be sampled: anchors first, then all others, or those of `passes`. Makes room for the
    latents."""
    run = store.run(job.run)
    plan = StoredPlan(store, run, job.config.seed)
    shape = latent_shape(job)
    run.generated.create_array("latent", (len(plan), *shape))
    run.generated.create_array("done_latent", (len(plan), 32))
    targets = [group.targets for group in plan.groups]
    keys, passes = view_keys(key, len(plan)), plan.passes() if passes is None else passes
    return Work(job, "sample", key, shared_model, work, run.generated, "done_latent", "latent", keys, passes, targets)


def latent_shape(job: Job) -> tuple[int, int, int]:
    """(C, h, w) of the model's latents."""
    unet = model_config(job).unet
    return unet.latent_channels, unet.latent_size, unet.latent_size


def group_sampler(job: Job, plan: StoredPlan, group: Group) -> SamplerConfig:
    """The sampler of one group: with `skip.near_steps` half of the steps where its views are close to captured ones."""
    config = sampler_config(job)
    if job.config.skip.near_steps and plan.distance(group) < NEAR:
        return replace(config, steps=math.ceil(config.steps / 2))
    return config


def group_evaluations(job: Job, group: Group, config: SamplerConfig) -> int:
    """Evaluations of the network for a group."""
    model = model_config(job)
    return evaluations(config, Schedule(model.schedule, model.views - len(group.conditions)))


def sampling_flops(job: Job, plan: StoredPlan) -> float:
    """Floating-point operations of sampling all groups."""
    config = model_config(job)
    each = count_flops(config.unet, config.views)
    return each * sum(group_evaluations(job, group, group_sampler(job, plan, group)) for group in plan.groups)


def sampler_decisions(job: Job, plan: StoredPlan, groups: Sequence[int]) -> list[Decision]:
    """What of the sampler's work was skipped for these groups."""
    if not groups:
        return []
    config, first = sampler_config(job), plan.groups[groups[0]]
    full, scale = group_evaluations(job, first, config), config.guidance.scale
    guided = full - config.steps
    how = f"guided by {scale:g} in {guided} of them" if guided else "without guidance"
    out = [chosen(f"{full} evaluations of the network a group: {config.steps} steps of {config.solver}, {how}.")]
    if scale != 1 and guided < config.steps:
        text = f"Skipped the unconditional half in {config.steps - guided} steps: guidance is on at log-SNR from "
        text += f"{config.guidance.low_log_snr:g} to {config.guidance.high_log_snr:g}."
        out.append(skipped(text, "guidance", evaluations=(config.steps - guided) * len(groups)))
    near = [c for g in groups if (c := group_sampler(job, plan, plan.groups[g])) != config]
    if near:
        saved = sum(full - group_evaluations(job, first, c) for c in near)
        text = f"{len(near)} of {len(groups)} groups are nearer than {NEAR:g} to a captured view and took "
        text += f"{near[0].steps} steps: {saved} of {full * len(groups)} evaluations were saved."
        out.append(skipped(text, "near_steps", evaluations=saved))
    return out


def work(job: Job, store: SceneStore, key: str, items: Sequence[int]) -> None:
    """A worker's share: sample the groups `items`, in order, and store the views of each as soon as they are there."""
    run = store.run(job.run)
    plan = StoredPlan(store, run, job.config.seed)
    keys = view_keys(key, len(plan))
    model = shared_model(job)
    targets = [view for g in items for view in plan.groups[g].targets]
    missing = {v for v in targets if not is_done(run.generated, "done_latent", v, keys[v], "latent")}
    groups = [plan.groups[g] for g in items if missing.intersection(plan.groups[g].targets)]
    at_once = job.config.execution.groups_at_once
    for config, chunk in alike([(group_sampler(job, plan, group), group) for group in groups], at_once):
        tensors = network_inputs(plan, chunk, latent_shape(job))
        latents, at_once = sample_at_most(at_once, model, tensors, config)
        for group, made in zip(chunk, latents.cpu(), strict=True):
            new = [i for i, view in enumerate(group.targets) if view in missing]
            views = [group.targets[i] for i in new]
            run.generated.write_views("latent", made[new].half().numpy(), views)
            run.generated.mark_done("done_latent", [keys[v] for v in views], views)


def alike(groups: Sequence[tuple[SamplerConfig, Group]], at_once: int) -> list[tuple[SamplerConfig, list[Group]]]:
    """Successive runs of at most `at_once` groups with one sampler and equal numbers of conditioning and target
    views."""
    chunks: list[tuple[SamplerConfig, list[Group]]] = []
    last = None
    for config, group in groups:
        shape = config, len(group.conditions), len(group.targets)
        if shape == last and len(chunks[-1][1]) < at_once:
            chunks[-1][1].append(group)
        else:
            chunks.append((config, [group]))
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


STAGE = Stage(
    "sample",
    execute,
    version=1,
    reads=("plan", "encode"),
    settings=settings_of("sample", "seed", without=("checkpoint",)),  # the hash of its weights is among the inputs
    inputs=inputs,
    wanted=generates,
)
