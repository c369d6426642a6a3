"""`cat3d train sweep`: scenes with exact depth become the plane sweep's weights; goes on where it was stopped."""

from __future__ import annotations

import dataclasses
import json
import math
import time
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from cat3d_core.diffusion import load_state, save_state
from cat3d_core.matching.checkpoint import describe_sweep, load_sweep, save_sweep
from cat3d_core.matching.config import SweepConfig
from cat3d_core.matching.network import SweepNetwork
from cat3d_core.matching.training import SweepTrainConfig, SweepTrainer, validation_psnr
from cat3d_core.random import generator
from flows.errors import InputError
from flows.progress import console, meter
from flows.training import renders
from flows.training.loop import crossed
from flows.training.prepare import claim, read_photos
from flows.training.ranks import Ranks
from flows.training.sweep_batches import GeometryBank, batch, collated, prepared
from flows.training.worlds.package import TRAINING
from flows.training.worlds.shards import SHARD_GROUPS, shard_numbers, world_shards
from schemas.errors import ConfigError
from schemas.sweep_training import SWEEP_TRAINING, SWEEP_VALIDATION, SweepRunConfig, SweepStage
from schemas.tables import append_rows

RECORD, STATE, WEIGHTS = "training.json", "state.safetensors", "sweep.safetensors"
TABLES, VALIDATION, WORLDS = "training", "validation", "worlds"
#: Settings that may change between the legs of one training.
FREE = {"name", "note", "steps", "minutes", "device", "log_steps", "save_minutes", "validate_minutes"}
_VALIDATED = (3, 1)
_VALIDATION_SCENES, _VALIDATION_TARGETS = 10, 3


@dataclass
class Progress:
    """What has been spent, what the running stage is, and when it began."""

    seconds: float = 0.0
    stage: int = -1
    stage_step: int = 0


def train_sweep(config: SweepRunConfig, out: Path, own: Ranks, bank_only: bool = False) -> None:
    """Do what is not done yet of the bank and of the training. Ranks share the rendering; the first one trains.

    Leaves sweep.safetensors (averaged weights), state.safetensors, training/*.parquet and validation/*.parquet.
    Raises ConfigError for a folder that belongs to another training, InputError for folders without scenes."""
    if own.first and not bank_only:
        document = json.loads(config.model_dump_json())
        claim(out / RECORD, document, set(document) - FREE if (out / STATE).exists() else ())
    folder = config.bank.folder or out
    render_bank(config, folder, own)
    if bank_only or not own.first:
        return
    worlds = [folder / WORLDS] if config.bank.worlds else []
    bank = GeometryBank([folder, *worlds, *config.bank.others], config.bank.held)
    empty = [str(path) for path in bank.folders if not renders.shards(path, "renders")]
    if empty:
        raise InputError(f"There are no scenes (renders/*.safetensors) in {', '.join(empty)}.")
    if not len(bank):
        raise InputError(f"The bank has no more than the {config.bank.held} shards of each folder that are held out.")
    network = starting_network(config)
    trainer = SweepTrainer(
        SweepTrainConfig(config.weight_decay, config.clip_norm, config.ema_decay, config.precision), network, own.device
    )
    progress = Progress()
    if (out / STATE).exists():
        state, document = load_state(out / STATE)
        trainer.load_state(state)
        progress = Progress(**document)
    millions = sum(p.numel() for p in network.parameters()) / 1e6
    console.print(f"{config.name}: {millions:.1f} M parameters, {len(bank)} scenes, {own.device}")
    _loop(config, out, trainer, bank, progress)


def starting_network(config: SweepRunConfig) -> SweepNetwork:
    """A new network, or the weights of `start`, whose blending alone `network` may change. Raises ConfigError where
    those are of another network."""
    torch.manual_seed(config.seed)
    started = None if config.start is None else load_sweep(config.start)
    known = SweepConfig() if started is None else started.config
    try:
        wanted = SweepConfig.from_fields(json.loads(known.to_json()) | config.network)
    except TypeError as error:
        raise ConfigError(f"network: {error}.") from None
    if started is None:
        return SweepNetwork(wanted)
    if dataclasses.replace(wanted, sharpness=known.sharpness) != known:
        raise ConfigError(f"network: {config.start} holds another network ({known}).")
    started.config = wanted
    return started


def render_bank(config: SweepRunConfig, folder: Path, own: Ranks) -> None:
    """Render the procedural scenes, and the worlds, that are not there yet."""
    bank, seed = config.bank, config.seed if config.bank.seed is None else config.bank.seed
    if own.first:
        identity = {
            **json.loads(
                bank.model_dump_json(exclude={"folder", "others", "held", "scenes", "worlds", "world_groups"})
            ),
            "seed": seed,
        }
        claim(folder / "bank.json", identity, set(identity) if renders.shards(folder, "renders") else ())
    own.barrier()
    numbers = renders.shard_numbers(bank.scenes)
    mine = numbers[own.rank :: own.world]
    photos = None
    if bank.textures and len(renders.shards(folder, "renders")) < len(numbers):
        photos = read_photos(bank.textures)
    total = sum(min(renders.SHARD_SCENES, bank.scenes - n * renders.SHARD_SCENES) for n in mine)
    with meter("render scenes with depth", total) as bar:
        renders.render_shards(
            folder, bank.families, bank.scenes, bank.views, bank.size, seed, photos, own.device, mine, bar.advance,
            with_depth=True,
        )  # fmt: skip
    if bank.worlds:
        turns = shard_numbers(bank.world_groups)[own.rank :: own.world]
        with meter("photograph worlds", SHARD_GROUPS * len(turns)) as bar:
            world_shards(folder / WORLDS, bank.worlds, TRAINING, turns, bank.views, bank.size, seed, bar.advance)
    own.barrier()


def share_done(config: SweepRunConfig, steps: int, seconds: float) -> float:
    """0..1: of the steps, or of the minutes."""
    return min(steps / config.steps if config.steps is not None else seconds / (60 * (config.minutes or 1)), 1.0)


def stage_at(config: SweepRunConfig, done: float) -> int:
    """The number of the stage that runs at this share of the training."""
    passed = 0.0
    for number, stage in enumerate(config.stages):
        passed += stage.share
        if done < passed - 1e-9:
            return number
    return len(config.stages) - 1


def rate_at(config: SweepRunConfig, done: float, since: int) -> float:
    """Half a cosine over the training, with a warm-up over the steps `since` a stage or a leg began."""
    cosine = 0.5 * (1 + math.cos(math.pi * done))
    rate = config.final_learning_rate + (config.learning_rate - config.final_learning_rate) * cosine
    return rate * min((since + 1) / max(config.warmup_steps, 1), 1.0)


def shape_of(config: SweepRunConfig, stage: SweepStage, step: int) -> tuple[int, int, int]:
    """How many scenes, photos and targets the batch of a step has."""
    weights = torch.tensor(config.photos, dtype=torch.float64)
    photos = int(torch.multinomial(weights, 1, generator=generator(config.seed, "photos", step))) + 1
    scenes = max(1, round(stage.scenes * min(1.0, 3 / photos)))
    return scenes, photos, min(stage.targets, config.bank.views - photos)


def _loop(config: SweepRunConfig, out: Path, trainer: SweepTrainer, bank: GeometryBank, progress: Progress) -> None:
    rows: list[dict[str, Any]] = []
    window: dict[str, list[float]] = defaultdict(list)
    total = config.steps or round(60 * (config.minutes or 0))
    with meter(f"train {config.name}", total) as bar:
        while (done := share_done(config, trainer.steps, progress.seconds)) < 1:
            before, started = progress.seconds, time.monotonic()
            number = stage_at(config, done)
            if number != progress.stage:
                progress.stage, progress.stage_step = number, trainer.steps
            stage = config.stages[number]
            scenes, photos, targets = shape_of(config, stage, trainer.steps)
            spread = config.spread[0] + (config.spread[1] - config.spread[0]) * min(done / 0.7, 1.0)
            drawn = batch(
                bank, scenes, photos, targets, stage.size, spread, generator(config.seed, "sweep", trainer.steps)
            )
            rate = rate_at(config, done, trainer.steps - progress.stage_step)
            numbers = trainer.step(drawn, rate)
            progress.seconds += time.monotonic() - started
            for name in ("loss", "colour", "depth", "sure"):
                window[name].append(numbers[name])
            window["targets"].append(scenes * targets)
            window["seconds"].append(progress.seconds - before)
            now = share_done(config, trainer.steps, progress.seconds)
            bar.update(round(total * now), f"loss {numbers['loss']:.3f}")
            if trainer.steps % config.log_steps == 0 or now >= 1:
                rows.append(_row(trainer, numbers, window, progress, stage.size, len(bank), rate))
                window.clear()
            if now >= 1 or crossed(before, progress.seconds, 60 * config.save_minutes):
                _save(config, out, trainer, rows, progress, bank)
                rows = []
                bank.refresh()
            if now >= 1 or crossed(before, progress.seconds, 60 * config.validate_minutes):
                _validate(out, trainer, bank, stage.size)


def _row(
    trainer: SweepTrainer, numbers: dict[str, float], window: dict[str, list[float]], progress: Progress, size: int,
    scenes: int, rate: float,
) -> dict[str, Any]:  # fmt: skip
    cuda = trainer.device.type == "cuda"
    means = {name: sum(window[name]) / len(window[name]) for name in ("loss", "colour", "depth", "sure")}
    return means | {
        "step": trainer.steps, "seconds": progress.seconds, "size": size, "scenes": scenes, "learning_rate": rate,
        "gradient_norm": numbers["gradient_norm"], "targets_per_s": sum(window["targets"]) / sum(window["seconds"]),
        "device": torch.cuda.get_device_name(trainer.device) if cuda else "cpu",
    }  # fmt: skip


def _save(
    config: SweepRunConfig, out: Path, trainer: SweepTrainer, rows: Sequence[dict[str, Any]], progress: Progress,
    bank: GeometryBank,
) -> None:  # fmt: skip
    """Table, weights, state in this order: a run killed in between repeats the steps, and replaces the table's file."""
    if rows:
        append_rows(out / TABLES, SWEEP_TRAINING, list(rows), f"from_{rows[0]['step']:08d}")
    provenance = {
        "training": json.loads(config.model_dump_json()), "steps": trainer.steps, "scenes": len(bank),
        "hours": round(progress.seconds / 3600, 3),
    }  # fmt: skip
    if config.start is not None:
        provenance["started_from"] = describe_sweep(config.start)["provenance"]
    save_sweep(out / WEIGHTS, trainer.averaged(), provenance)
    save_state(out / STATE, trainer.state(), vars(progress))


def _validate(out: Path, trainer: SweepTrainer, bank: GeometryBank, size: int) -> None:
    """PSNR on the first held scenes of each folder, from near and wide cameras alike."""
    network, precision = trainer.averaged().to(trainer.device), trainer.config.precision
    rows: list[dict[str, Any]] = []
    for folder, shards in zip(bank.named(), bank.sources(validation=True), strict=True):
        for photos in _VALIDATED:
            found = []
            for number in range(min(_VALIDATION_SCENES, len(shards[0]["family"]))):
                random = generator(0, "validation", number)
                raw = {name: tensor[number] for name, tensor in shards[0].items() if name != "family"}
                order = torch.randperm(len(raw["image"]), generator=random)[: photos + _VALIDATION_TARGETS]
                scene = prepared({name: tensor[order] for name, tensor in raw.items()}, size, random)
                found.append(validation_psnr(network, collated([scene], photos).to(trainer.device), precision))
            rows.append({"step": trainer.steps, "source": folder, "photos": photos, "size": size,
                         "psnr_db": sum(found) / len(found)})  # fmt: skip
    append_rows(out / VALIDATION, SWEEP_VALIDATION, rows, f"step_{trainer.steps:08d}")
    console.print("  " + ", ".join(f"{r['source']} {r['photos']}: {r['psnr_db']:.2f} dB" for r in rows))
