"""Stage sample: groups of the plan -> latents of generated views, fanned out over workers."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import groupby
from typing import Any

from cat3d_core.diffusion import SamplerConfig
from cat3d_core.generation import Cost, MemoryTooSmall
from cat3d_core.plan import Group
from flows.errors import WorkerError
from flows.generation.groups import StoredPlan, view_keys
from flows.generation.hints import explained_views
from flows.generation.imported import samples
from flows.generation.open import generator_spec, open_generator
from flows.generation.opening import opening
from flows.generation.rounds import OneRound, Rounds
from flows.generation.sampling import sampler_config, sampler_settings
from flows.jobs.job import Job, Outcome
from flows.jobs.needs import Needs
from flows.jobs.stage import Stage, settings_of
from flows.workers.fan_out import fan_out
from flows.workers.orders import Totals
from flows.workers.work import ViewMarks, ViewWork, is_done
from schemas.decisions import Decision, chosen, skipped
from schemas.scene_store import SceneStore

#: `skip.near_steps`: mean pose distance (scene distances, about radians of turning) from a group's views to the nearest
#: captured view below which the group takes half of the steps.
NEAR = 0.25
NEEDS = Needs(gpu=True, memory_gb=1.5)


def inputs(job: Job, keys: Mapping[str, str]) -> dict[str, Any]:
    """The generator, the sampler it is used with, and how the views are chosen."""
    rounds = job.config.skip.rounds
    found = {"model": generator_spec(job).identity, "sampler": sampler_settings(job), "rounds": rounds}
    # Brief fields heed masks since there are some to train by.
    return found | ({"masks": True} if rounds and job.capture().mask_training else {})


def execute(job: Job, store: SceneStore, key: str) -> Outcome:
    """Write `generated/latent`, each view recorded in `done_latent` when it is complete; only missing ones are made.

    Views that the scene doesn't need are recorded there as left out on purpose.
    """
    opening(job)  # before workers are started in vain
    run = store.run(job.run)
    run.generated.set_attrs(terms=generator_spec(job).terms)
    plan = StoredPlan(store, run, job.config.seed)
    explained = explained_views(job, run)
    rounds = Rounds(job, store, plan, sampling_flops(job, plan)) if job.config.skip.rounds else OneRound(plan)
    totals, groups, spared = Totals(), [], set(range(len(plan.groups)))
    for planned in rounds:
        spared -= {g for items in planned for g in items}
        passes = [[g for g in items if not explained[plan.groups[g].targets[0]]] for items in planned]
        share = sample_work(job, store, key, passes)
        groups += [g for items in share.passes for g in items]
        label = f"sample {job.scene_id} {job.run}"
        totals += fan_out([share], job.config.execution, label, here=job.config.skip.workers)
    made = {view for g in rounds.kept for view in plan.groups[g].targets}
    left_out = sorted(set(range(len(plan))) - made)
    run.generated.mark_skipped("done_latent", [v for v in range(len(plan)) if v not in made or explained[v]])
    decisions = []
    if left_out:
        saved = sum(
            group_cost(job, plan.groups[g], group_sampler(job, plan, plan.groups[g])).evaluations for g in spared
        )
        text = f"{len(left_out)} of {len(plan)} planned views were left out; {saved} network evaluations were saved."
        switch = "rounds" if plan.needed else "covered_path"
        decisions.append(skipped(text, switch, views=len(left_out), evaluations=saved))
    sampled = [g for g in rounds.kept if not explained[plan.groups[g].targets[0]]]
    if len(sampled) < len(rounds.kept):
        shown = sorted(set(rounds.kept) - set(sampled))
        saved = sum(
            group_cost(job, plan.groups[g], group_sampler(job, plan, plan.groups[g])).evaluations for g in shown
        )
        text = f"{len(shown)} of {len(rounds.kept)} groups were not sampled, since photos show all of their views; "
        decisions.append(skipped(f"{text}{saved} network evaluations were saved.", "explained", evaluations=saved))
    decisions += rounds.decisions + sampler_decisions(job, plan, sampled) + totals.decisions
    configs = [group_sampler(job, plan, plan.groups[g]) for g in groups]
    counts = {"views": sum(len(plan.groups[g].targets) for g in groups), "groups": len(groups)}
    spent = sum(group_cost(job, plan.groups[g], c).evaluations for g, c in zip(groups, configs, strict=True))
    counts |= {"steps": sum(c.steps for c in configs), "evaluations": spent}
    return Outcome(counts | totals.work(), decisions, totals.usage, totals.waited)


def sample_work(job: Job, store: SceneStore, key: str, passes: Sequence[Sequence[int]] | None = None) -> ViewWork:
    """The groups that are to be sampled: anchors first, then all others, or those of `passes`. Makes room for the
    latents."""
    run = store.run(job.run)
    plan = StoredPlan(store, run, job.config.seed)
    run.generated.create_array("latent", (len(plan), *generator_spec(job).latent_shape))
    run.generated.create_array("done_latent", (len(plan), 32))
    targets = [group.targets for group in plan.groups]
    keys, passes = view_keys(key, len(plan)), plan.passes() if passes is None else passes
    views = ViewMarks(run.generated, "done_latent", "latent", keys)
    return ViewWork(job, "sample", key, NEEDS, open_generator, work, views, passes, targets)


def group_sampler(job: Job, plan: StoredPlan, group: Group) -> SamplerConfig:
    """The sampler of one group: with `skip.near_steps` half of the steps where its views are close to captured ones."""
    config = sampler_config(job)
    if job.config.skip.near_steps and plan.distance(group) < NEAR:
        return replace(config, steps=math.ceil(config.steps / 2))
    return config


def group_cost(job: Job, group: Group, config: SamplerConfig) -> Cost:
    """Work of sampling a group."""
    return generator_spec(job).cost(len(group.conditions), len(group.targets), config)


def sampling_flops(job: Job, plan: StoredPlan) -> float:
    """Floating-point operations of sampling all groups."""
    return sum(group_cost(job, group, group_sampler(job, plan, group)).flops for group in plan.groups)


def sampler_decisions(job: Job, plan: StoredPlan, groups: Sequence[int]) -> list[Decision]:
    """What of the sampler's work was skipped for these groups."""
    if not groups:
        return []
    config, first = sampler_config(job), plan.groups[groups[0]]
    full, scale = group_cost(job, first, config).evaluations, config.guidance.scale
    unguided = replace(config, guidance=replace(config.guidance, scale=1.0))
    everywhere = replace(config, guidance=replace(config.guidance, low_log_snr=-math.inf, high_log_snr=math.inf))
    guided = full - group_cost(job, first, unguided).evaluations
    spared = group_cost(job, first, everywhere).evaluations - full
    how = f"guided by {scale:g} in {guided} of them" if guided else "without guidance"
    out = [chosen(f"{full} evaluations of the network a group: {config.steps} steps of {config.solver}, {how}.")]
    whole = sampler_config(job, shortened=False)
    shorter = group_cost(job, first, whole).evaluations - full
    if shorter > 0:
        text = f"{config.steps} steps of {config.solver} in place of {whole.steps} of {whole.solver}."
        out.append(skipped(text, "solver", evaluations=shorter * len(groups)))
    if spared:
        text = f"Skipped the unconditional half in {spared} steps: guidance is on at log-SNR from "
        text += f"{config.guidance.low_log_snr:g} to {config.guidance.high_log_snr:g}."
        out.append(skipped(text, "guidance", evaluations=spared * len(groups)))
    near = [c for g in groups if (c := group_sampler(job, plan, plan.groups[g])) != config]
    if near:
        saved = sum(full - group_cost(job, first, c).evaluations for c in near)
        text = f"{len(near)} of {len(groups)} groups are nearer than {NEAR:g} to a captured view and took "
        text += f"{near[0].steps} steps: {saved} of {full * len(groups)} evaluations were saved."
        out.append(skipped(text, "near_steps", evaluations=saved))
    return out


def work(job: Job, store: SceneStore, key: str, items: Sequence[int]) -> None:
    """A worker's share: sample the groups `items`, in order, and store the views of each as soon as they are there."""
    run = store.run(job.run)
    plan = StoredPlan(store, run, job.config.seed, job.hinted)
    keys = view_keys(key, len(plan))
    generator = open_generator(job)
    targets = [view for g in items for view in plan.groups[g].targets]
    missing = {v for v in targets if not is_done(run.generated, "done_latent", v, keys[v], "latent")}
    groups = [plan.groups[g] for g in items if missing.intersection(plan.groups[g].targets)]
    for config, alike in groupby(groups, lambda group: group_sampler(job, plan, group)):
        chosen_groups = list(alike)
        made = generator.sample((plan.view_group(group, generator) for group in chosen_groups), config)
        try:
            for group, latents in zip(chosen_groups, made, strict=True):
                new = [i for i, view in enumerate(group.targets) if view in missing]
                views = [group.targets[i] for i in new]
                run.generated.write_views("latent", latents[new].half().numpy(), views)
                run.generated.mark_done("done_latent", [keys[v] for v in views], views)
        except MemoryTooSmall as error:
            raise WorkerError(str(error)) from None


STAGE = Stage(
    "sample",
    execute,
    version=1,
    reads=("plan", "match", "encode"),
    # The generator's identity is among the inputs, and so is the start.
    settings=settings_of("sample", "seed", without=("generator", "checkpoint", "start")),
    inputs=inputs,
    wanted=samples,
    needs=NEEDS,
    spreads=True,
)
