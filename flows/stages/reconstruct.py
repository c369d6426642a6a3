"""Stage reconstruct: captured (and generated) views -> one field, checkpointed while it trains."""

from __future__ import annotations

import dataclasses
import os
import time
from typing import Any

import torch
from safetensors import safe_open
from safetensors.torch import save_file

from cat3d_core.metrics.perceptual import find_perceptual, perceptual_name
from cat3d_core.zipnerf import PRESETS, Field, ReconstructConfig, Trainer, Views
from flows.pipeline.jobs import Job, Outcome
from flows.progress import meter
from flows.stages.training_views import training_views
from schemas.errors import ConfigError
from schemas.scene_store import Run, SceneStore

VERSION = 5
CHECKPOINT_INTERVAL_S = 20.0
#: `skip.rays`: steps that see as many rays as there are pixels, at least, and the fewest rays of a step. With generated
#: views, whose pixels are many and uncertain, a step does with this share of its rays if all steps together still see
#: as many as twice the pixels: short trainings need them all (150 steps: up to 1.2 dB).
PASSES, FEWEST_RAYS, GENERATED_SHARE, LEAST_PASSES = 24, 256, 0.75, 2
#: `skip.plateau` with more captured views than this: their pixels tell how well other views are met, so training goes
#: on for as long as they improve at all. (With few views they only tell how well those are remembered.)
FEW_VIEWS = 9
PATIENT: dict[str, Any] = {"plateau_patience": 3, "plateau_every": 50, "plateau_tolerance": 0.01, "plateau_from": 0.0}
#: `skip.plateau` with generated views, which go on to shape what captured views don't show when those are learned
#: already: no end is looked for before this share of the steps, and the learning rate falls over that one.
GENERATED: dict[str, Any] = {"plateau_from": 0.4, "plateau_cooldown": 0.2}
#: CAT3D: LPIPS weight 1 on CO3D and mip-NeRF 360, 0.25 elsewhere.
STRONG_LPIPS = 4.0
STRONG_LPIPS_DATASETS = ("co3d", "mip360", "mipnerf360")


def skip_settings(iterations: int) -> dict[str, dict[str, Any]]:
    """The trainer's settings that each switch of the configuration's section `skip` turns on."""
    return {
        "empty_space": {"skip_transmittance": 0.01},
        "proposals": {"proposal_every": 4},
        "lpips": {"lpips_every": 2},
        "low_resolution": {"low_resolution_iterations": iterations // 8},
        "plateau": {"plateau_patience": 2, "plateau_every": 25, "plateau_tolerance": 0.1},
    }


def trainer_config(job: Job) -> ReconstructConfig:
    """The preset with the method's and family's LPIPS weight, what the run skips, and its overrides.

    Raises ConfigError naming a bad setting.
    """
    settings = job.config.reconstruct
    config = PRESETS[settings.preset]
    if job.config.method == "zipnerf":
        # The paper's baseline has no perceptual loss: captured views agree with each other. (Measured on llff_fern, 3
        # views, 101x76, 300 iterations of `fast`: 24.7 dB without, 18.9 dB with.)
        config = dataclasses.replace(config, lpips_weight=0.0)
    elif job.dataset in STRONG_LPIPS_DATASETS:
        config = dataclasses.replace(config, lpips_weight=STRONG_LPIPS * config.lpips_weight)
    iterations = settings.overrides.get("iterations", config.iterations)
    off = ReconstructConfig()  # as in the paper: nothing is skipped
    for name, changes in skip_settings(iterations if isinstance(iterations, int) else config.iterations).items():
        on = getattr(job.config.skip, name)
        on = on and not (name == "low_resolution" and config.lpips_weight == 0)  # patches are all it saves
        chosen = {n: value if on else getattr(off, n) for n, value in changes.items()}
        config = dataclasses.replace(config, **chosen)
    known = {f.name for f in dataclasses.fields(ReconstructConfig)}
    unknown = sorted(set(settings.overrides) - known)
    if unknown:
        raise ConfigError(
            f"reconstruct.overrides: {unknown[0]} is not a setting of the trainer; "
            f"those are {', '.join(sorted(known))}."
        )
    values: dict[str, Any] = {n: tuple(v) if isinstance(v, list) else v for n, v in settings.overrides.items()}
    try:
        return dataclasses.replace(config, **values)
    except (ValueError, TypeError) as error:
        raise ConfigError(f"reconstruct.overrides: {error}") from None


def inputs(job: Job) -> dict[str, Any]:
    """The full trainer configuration, the LPIPS network, and the rules of `fitted`: a changed preset or rule makes old
    fields stale."""
    config = trainer_config(job)
    perceptual = perceptual_name() if config.lpips_weight > 0 else None
    rays = [PASSES, FEWEST_RAYS, GENERATED_SHARE, LEAST_PASSES] if job.config.skip.rays else False
    found: dict[str, Any] = {"trainer": dataclasses.asdict(config), "perceptual": perceptual, "rays": rays}
    found |= {"detail": job.config.skip.detail, "seen": job.config.skip.seen}
    if job.config.skip.plateau:
        found["plateau"] = [FEW_VIEWS, PATIENT, GENERATED]
    return found


def execute(job: Job, store: SceneStore, key: str) -> Outcome:
    """Train the field, write `field/` (parameters, training record); goes on from its checkpoint if it was stopped."""
    run = store.run(job.run)
    config = trainer_config(job)
    views, seen, decisions = training_views(job, store, run)
    config, told = fitted(job, config, views, seen)
    decisions += told
    smallest = int(views.size.min())
    if config.patch_size > smallest:
        config = dataclasses.replace(config, patch_size=smallest)
        if config.lpips_weight > 0:
            decisions.append(f"LPIPS patches are {smallest} pixels, the shorter side of the smallest view.")
    perceptual = find_perceptual() if config.lpips_weight > 0 else None
    if perceptual is None and config.lpips_weight > 0:
        decisions.append("No perceptual network was found on this machine: trained without the LPIPS loss.")
    elif perceptual is not None and config.patch_size < perceptual.architecture.smallest:
        decisions.append(
            f"Trained without the LPIPS loss: {perceptual.name} needs patches of {perceptual.architecture.smallest} "
            f"pixels, and these are {config.patch_size}."
        )
        perceptual = None
    device = "cuda" if torch.cuda.is_available() else "cpu"
    trainer = Trainer(config, views, job.config.seed, device, perceptual)
    checkpoint = Checkpoint(job, key)
    resumed = checkpoint.load(trainer)
    if resumed:
        decisions.append(f"Went on from the checkpoint at iteration {trainer.iteration}.")
    record = []
    saved = started = time.monotonic()
    with meter(f"reconstruct {job.scene_id} {job.run}", config.iterations) as progress:
        while not trainer.finished:
            step = trainer.step()
            if trainer.iteration % 10 == 0 or trainer.finished:
                record.append([trainer.iteration, time.monotonic() - started, step["loss"], step["psnr"]])
            progress.update(trainer.iteration, f"{step['psnr']:.1f} dB")
            if time.monotonic() - saved > CHECKPOINT_INTERVAL_S:
                checkpoint.save(trainer)
                saved = time.monotonic()
    decisions += skip_decisions(trainer)
    if trainer.skipped:
        decisions.append(f"{trainer.skipped} steps with a non-finite loss or gradient were skipped.")
    write_field(run, trainer.field, record)
    checkpoint.remove()
    rays = (trainer.iteration - resumed) * config.batch_rays
    return Outcome({"views": len(views), "steps": trainer.iteration - resumed, "rays": rays}, decisions)


def fitted(job: Job, config: ReconstructConfig, views: Views, seen: float = 0.0) -> tuple[ReconstructConfig, list[str]]:
    """The settings where they depend on what there is to train on, and why; overrides of the run stay. seen: share of
    the generated pixels that is left out, as captured views show it."""
    skip, captured = job.config.skip, int(views.captured.sum())
    changes: dict[str, Any] = {}
    decisions = []
    if captured == len(views):  # as for the baseline: captured views agree with each other
        changes |= {"lpips_weight": 0.0, "low_resolution_iterations": 0}
    if skip.plateau:
        changes |= GENERATED if captured < len(views) else {}
        changes |= PATIENT if captured > FEW_VIEWS else {}
    changes |= {"captured_share": max(config.captured_share, seen)}
    rays, why = enough_rays(config, int(views.counting.sum()), captured < len(views))
    if skip.rays and rays < config.batch_rays:
        changes |= {"batch_rays": rays}
        decisions.append(f"{rays} instead of {config.batch_rays} rays a step: {why}.")
    given = job.config.reconstruct.overrides
    return dataclasses.replace(config, **{n: v for n, v in changes.items() if n not in given}), decisions


def enough_rays(config: ReconstructConfig, pixels: int, generated: bool) -> tuple[int, str]:
    """Rays of a step that are enough for so many pixels, some of them generated or none, and why."""
    most = config.batch_rays
    if generated and config.iterations * GENERATED_SHARE * most >= LEAST_PASSES * pixels:
        most = round(GENERATED_SHARE * most)
    few = max(FEWEST_RAYS, pixels // PASSES)
    if few < most:
        return few, f"{PASSES} steps see as many as all pixels"
    return most, "most pixels are generated"


def skip_decisions(trainer: Trainer) -> list[str]:
    """What the training did without."""
    config, steps, out = trainer.config, trainer.iteration, []
    if config.low_resolution_iterations:
        out.append(f"Images of half the size in {min(steps, config.low_resolution_iterations)} of {steps} steps.")
    if config.proposal_every > 1:
        out.append(f"Proposals were trained at every {config.proposal_every}th step after the warm-up.")
    if config.lpips_every > 1 and trainer.perceptual is not None:
        out.append(f"The LPIPS loss was taken in one of {config.lpips_every} steps.")
    if config.skip_transmittance:
        out.append(f"The field was not asked where less than {config.skip_transmittance:g} of a ray's light is left.")
    if steps < config.iterations:
        out.append(
            f"Skipped {config.iterations - steps} of {config.iterations} steps: from step {trainer.plateau_at} on "
            "held-out pixels no longer improved, and a cool-down ended the training."
        )
    return out


def write_field(run: Run, field: Field, record: list[list[float]]) -> None:
    """Write the parameters and the training record (rows of iteration, seconds, loss, PSNR of the batch)."""
    run.remove("field")
    section = run.section("field", create=True)
    state = field.state_dict()
    for name, value in state.items():
        section.write(name, value.detach().float().cpu().numpy())
    section.write("record", torch.tensor(record, dtype=torch.float32).reshape(-1, 4).numpy())
    section.set_attrs(parameters=sorted(state), record_columns=["iteration", "seconds", "loss", "psnr_db"])


def read_field(job: Job, run: Run) -> Field:
    """The trained field as `write_field` left it, on this machine's device."""
    section = run.field
    field = Field(trainer_config(job))
    state = {name: torch.from_numpy(section.read(name)) for name in section.attrs["parameters"]}
    field.load_state_dict(state)
    return field.to("cuda" if torch.cuda.is_available() else "cpu").eval()


class Checkpoint:
    """The trainer's state on disk while the stage runs, beside the store, replaced atomically."""

    def __init__(self, job: Job, key: str) -> None:
        self.path = job.out / ".work" / f"{job.scene_id}-{job.run}.safetensors"
        self.key = key  # only a step with the same inputs and settings may go on from it

    def save(self, trainer: Trainer) -> None:
        """Write the state; a kill at any moment leaves the old or the new one."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        part = self.path.with_suffix(f".{os.getpid()}.part")
        save_file(trainer.state(), part, metadata={"key": self.key})
        os.replace(part, self.path)

    def load(self, trainer: Trainer) -> int:
        """Continue from the checkpoint if there is one of this very step; the iteration reached, or 0."""
        if not self.path.exists():
            return 0
        with safe_open(self.path, "pt") as file:
            if (file.metadata() or {}).get("key") != self.key:
                return 0
            trainer.load_state({name: file.get_tensor(name) for name in file.keys()})  # noqa: SIM118
        return trainer.iteration

    def remove(self) -> None:
        """The stage is complete; the state is no longer needed."""
        self.path.unlink(missing_ok=True)
