"""The training loop: batches from the bank, checkpoints, tables, sample sheets; goes on where it was stopped."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from cat3d_core.diffusion import (
    LatentBank,
    MultiViewModel,
    TrainConfig,
    Trainer,
    load_state,
    save_model,
    save_state,
)  # fmt: skip
from cat3d_core.diffusion.hint_bank import HintBank
from cat3d_core.diffusion.training import half_cosine
from cat3d_core.generation import Cat3dGenerator
from cat3d_core.random import generator
from flows.progress import meter
from flows.training.bank import jitter_scale
from flows.training.ranks import Ranks
from flows.training.sheets import HeldOut, sampled, scores, write_sheet
from schemas.tables import append_rows
from schemas.training import SAMPLES, TRAINING, TrainRunConfig

STATE, MODEL = "state.safetensors", "model.safetensors"
TABLES, SHEETS = "training", "samples"


@dataclass
class Clock:
    """What has been spent: seconds of training (the same on every rank) and groups of views seen on all ranks."""

    seconds: float = 0.0
    groups: int = 0


def train_config(config: TrainRunConfig) -> TrainConfig:
    """The core's settings; the learning rate is set for each step by `set_rate`."""
    o = config.optimizer
    return TrainConfig(
        learning_rate=o.learning_rate, final_learning_rate=o.learning_rate, warmup_steps=o.warmup_steps,
        weight_decay=o.weight_decay, clip_norm=o.clip_norm, ema_decay=o.ema_decay, accumulate=o.accumulate,
        drop_probability=o.drop_probability, drop=o.drop, hint_weight=o.hint_weight,
        min_snr_gamma=o.min_snr_gamma, precision=o.precision,
    )  # fmt: skip


def share_done(config: TrainRunConfig, steps: int, clock: Clock) -> float:
    """0..1: of the steps, or of the minutes."""
    if config.steps is not None:
        return min(steps / config.steps, 1.0)
    return min(clock.seconds / (60 * (config.minutes or 1)), 1.0)


def set_rate(trainer: Trainer, config: TrainRunConfig, done: float) -> None:
    """Half a cosine from the learning rate to the final one over the training, whether it counts steps or minutes."""
    peak, last = config.optimizer.learning_rate, config.optimizer.final_learning_rate
    fixed = half_cosine(peak, peak if last is None else last, done)
    trainer.config = replace(trainer.config, learning_rate=fixed, final_learning_rate=fixed)


def spread_at(config: TrainRunConfig, done: float) -> float:
    """Near cameras first, wider ones later: reached after 70 % of the training."""
    first, last = config.spread
    return first + (last - first) * min(done / 0.7, 1.0)


def optimizer_step(
    trainer: Trainer, config: TrainRunConfig, bank: LatentBank | HintBank, ranks: Ranks, done: float
) -> dict[str, float]:
    """All evaluations of one optimizer step; what is drawn depends on seed, evaluation and rank alone."""
    losses, record, views, groups = [], {}, config.model.views, config.optimizer.groups
    for _ in range(config.optimizer.accumulate):
        key, hints = (trainer.calls, ranks.rank), None
        modes = config.conditions if done >= config.joint_from else config.conditions[:1]
        given = modes[trainer.calls % len(modes)]
        if isinstance(bank, HintBank):
            latents, cameras, hints = bank.batch(groups, given, config.seed, *key)
        else:
            latents, cameras = bank.batch(groups, views, config.seed, *key, spread=spread_at(config, done))
        jitter = generator(config.seed, "jitter", *key)
        cameras, hints = jitter_scale(cameras, config.scale_jitter, jitter, hints)
        record = trainer.step(latents, cameras, given, hints)
        losses.append(record["loss"])
    return record | {"loss": sum(losses) / len(losses)}


def train(
    config: TrainRunConfig,
    folder: Path,
    model: MultiViewModel,
    bank: LatentBank | HintBank,
    scenes: HeldOut,
    ranks: Ranks,
    provenance: dict[str, Any],
) -> Trainer:
    """Train to the end, from folder/state.safetensors if it is there. Rank 0 writes.

    Leaves model.safetensors (averaged weights), state.safetensors, training/*.parquet, samples/*.parquet and .png.
    Raises FloatingPointError if the loss is not finite (the last checkpoint stays).
    """
    trainer, clock = Trainer(train_config(config), model, config.seed, ranks.device), Clock()
    if (folder / STATE).exists():
        state, document = load_state(folder / STATE)
        trainer.load_state(state)
        clock = Clock(document["seconds"], document["groups"])
    ranks.barrier()  # nobody writes a state before everybody has read it
    rows: list[dict[str, Any]] = []
    window = Window()
    total = config.steps or round(60 * (config.minutes or 0))
    with meter(f"train {config.name}", total) as bar:
        while (done := share_done(config, trainer.steps, clock)) < 1:
            before, started = clock.seconds, time.monotonic()
            set_rate(trainer, config, done)
            record = optimizer_step(trainer, config, bank, ranks, done)
            spent = ranks.agreed(time.monotonic() - started)
            seen = config.optimizer.groups * config.optimizer.accumulate * ranks.world
            clock = Clock(before + spent, clock.groups + seen)
            window.add(record["loss"], seen, spent)
            bar.update(round(total * share_done(config, trainer.steps, clock)), f"loss {record['loss']:.3f}")
            finished = share_done(config, trainer.steps, clock) >= 1
            if trainer.steps % config.log_steps == 0 or finished:
                rows.append(row(trainer, record, clock, window, spread_at(config, done), ranks))
                window = Window()
            if finished or crossed(before, clock.seconds, 60 * config.save_minutes):
                if ranks.first:
                    write_checkpoint(folder, trainer, clock, rows, provenance)
                rows = []
            if not finished and crossed(before, clock.seconds, 60 * config.sample_minutes) and ranks.first:
                write_samples(config, folder, trainer, scenes)
    if ranks.first:
        write_samples(config, folder, trainer, scenes)
    ranks.barrier()
    return trainer


class Window:
    """Sums since the last row of the table."""

    def __init__(self) -> None:
        self.losses: list[float] = []
        self.groups, self.seconds = 0, 0.0

    def add(self, loss: float, groups: int, seconds: float) -> None:
        self.losses.append(loss)
        self.groups, self.seconds = self.groups + groups, self.seconds + seconds


def crossed(before: float, after: float, period: float) -> bool:
    """Whether a multiple of the period lies in (before, after]."""
    return after // period > before // period


def row(
    trainer: Trainer, record: dict[str, float], clock: Clock, window: Window, spread: float, ranks: Ranks
) -> dict[str, Any]:
    """One row of the table TRAINING."""
    cuda = ranks.device.type == "cuda"
    return {
        "step": trainer.steps, "groups": clock.groups, "seconds": clock.seconds,
        "loss": sum(window.losses) / len(window.losses), "learning_rate": record["lr"],
        "gradient_norm": record["grad_norm"], "spread": spread, "groups_per_s": window.groups / window.seconds,
        "ranks": ranks.world, "device": torch.cuda.get_device_name(ranks.device) if cuda else "cpu",
    }  # fmt: skip


def write_checkpoint(
    folder: Path, trainer: Trainer, clock: Clock, rows: list[dict[str, Any]], provenance: dict[str, Any]
) -> None:
    """Table, model, state in this order: a run killed in between repeats the steps, and replaces the table's file.

    The file is named by the first of its steps, which is where a resumed run begins again."""
    if rows:
        append_rows(folder / TABLES, TRAINING, rows, f"from_{rows[0]['step']:08d}")
    spent = {"steps": trainer.steps, "groups_of_views": clock.groups, "hours": round(clock.seconds / 3600, 3)}
    save_model(folder / MODEL, trainer.ema_model(), provenance | spent)
    save_state(folder / STATE, trainer.state(), {"seconds": clock.seconds, "groups": clock.groups})


def write_samples(config: TrainRunConfig, folder: Path, trainer: Trainer, scenes: HeldOut) -> None:
    """Sample the averaged weights on held-out scenes: rows and a sheet, unless those of this step are there."""
    name, given = f"step_{trainer.steps:08d}", max(config.conditions)
    if (folder / SHEETS / f"{name}.png").exists():
        return
    generator = Cat3dGenerator(trainer.ema_model().to(trainer.device))
    images = sampled(generator, scenes, given, config.sample_steps)
    append_rows(folder / SHEETS, SAMPLES, scores(images, scenes, given, trainer.steps), name)
    write_sheet(folder / SHEETS / f"{name}.png", images, scenes, given)
