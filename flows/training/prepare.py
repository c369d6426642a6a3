"""What a training works on: rendered scenes, an autoencoder, the bank of latents. Made once, kept in a folder."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Collection
from pathlib import Path
from typing import Any

import torch

from cat3d_core.diffusion import Autoencoder, LatentBank, ModelConfig, load_model
from cat3d_core.diffusion.hint_bank import HintBank
from cat3d_core.matching.checkpoint import describe_sweep, load_sweep
from cat3d_core.weights import default_model_path, default_sweep_path
from flows.errors import InputError
from flows.media.images import read_image
from flows.progress import console, meter
from flows.training import renders
from flows.training.autoencoder import (
    load_autoencoder,
    new_autoencoder,
    reconstruction_psnr,
    save_autoencoder,
    train_autoencoder,
)
from flows.training.bank import encode_shards, load_bank
from flows.training.hint_bank import load_hint_bank, predict_shards, sources
from flows.training.ranks import Ranks
from flows.training.worlds.package import TRAINING
from flows.training.worlds.shards import SHARD_GROUPS, shard_numbers, world_shards
from schemas.errors import ConfigError
from schemas.training import TrainRunConfig

AUTOENCODER = "autoencoder.safetensors"


def prepare(
    config: TrainRunConfig, network: ModelConfig, folder: Path, own: Ranks
) -> tuple[Autoencoder, LatentBank | HintBank]:
    """Render, get the autoencoder, encode or, for a network that takes hints, predict groups with them; each is skipped
    where its result is in `folder`. The ranks share the work.

    Raises ConfigError for a bank that is too large, or a folder that holds another one."""
    bank, size, seed = config.bank, network.image_size, bank_seed(config)
    groups = bank.world_groups if bank.worlds else 0
    needed = renders.bank_bytes(bank.scenes + groups, bank.views, size, bank.variants, network.unet.latent_channels)
    if needed > bank.max_gib * 2**30:
        raise ConfigError(
            f"The bank would take {needed / 2**30:.1f} GiB, more than bank.max_gib = {bank.max_gib:g} allows; ask for "
            "fewer scenes, views or variants, or allow more."
        )
    if own.first:
        made = {"bank", "image_size", "seed"} if renders.shards(folder, "renders") else set()
        made |= {"network", "autoencoder"} if (folder / AUTOENCODER).exists() else set()
        claim(folder / "bank.json", _identity(config, network), made)
    own.barrier()
    procedural = renders.shard_numbers(bank.scenes)
    mine = procedural[own.rank :: own.world]
    everything = range(len(procedural) + len(shard_numbers(groups)))
    kind = "renders" if network.unet.hints else "latents"
    complete = len(renders.shards(folder, kind)) == len(everything)
    photos = read_photos(bank.textures) if bank.textures and not complete else None
    scenes = sum(min(renders.SHARD_SCENES, bank.scenes - n * renders.SHARD_SCENES) for n in mine)
    with meter("render scenes", scenes) as bar:
        renders.render_shards(
            folder, bank.families, bank.scenes, bank.views, size, seed, photos, own.device, mine, bar.advance
        )
    if bank.worlds:
        turns = shard_numbers(groups)[own.rank :: own.world]
        with meter("photograph worlds", SHARD_GROUPS * len(turns)) as bar:
            world_shards(folder, bank.worlds, TRAINING, turns, bank.views, size, seed, bar.advance, len(procedural))
    own.barrier()
    autoencoder = get_autoencoder(config, network, folder, photos, own)
    if network.unet.hints:
        return autoencoder.cpu(), hinted(config, network, folder, autoencoder, own)
    mine = everything[own.rank :: own.world]
    with meter("encode shards", len(mine)) as bar:
        encode_shards(folder, autoencoder, bank.variants, own.device, mine, bar.advance)
    own.barrier()
    latents = load_bank(folder, size)
    console.print(f"  bank: {len(latents)} scenes of {bank.views} views, {needed / 2**20:.0f} MiB in {folder}")
    return autoencoder.cpu(), latents


def hinted(
    config: TrainRunConfig, network: ModelConfig, folder: Path, autoencoder: Autoencoder, own: Ranks
) -> HintBank:
    """The groups with hints, predicted where they are not there yet."""
    tasks = sources(folder, config.bank.others)
    mine = tasks[own.rank :: own.world]
    sweep = load_sweep(config.bank.sweep or default_sweep_path(), own.device)
    with meter("predict hints of shards", len(mine)) as bar:
        predict_shards(
            folder, mine, sweep, autoencoder.to(own.device).eval(), config.conditions, config.model.views,
            network.image_size, bank_seed(config), bar.advance,
        )  # fmt: skip
    own.barrier()
    bank = load_hint_bank(folder, network.image_size)
    console.print(f"  bank: {len(bank)} groups of {config.model.views} views with hints, in {folder}")
    return bank


def bank_seed(config: TrainRunConfig) -> int:
    """What a bank's scenes and its autoencoder are drawn from."""
    return config.seed if config.bank.seed is None else config.bank.seed


def _identity(config: TrainRunConfig, network: ModelConfig) -> dict[str, Any]:
    """What the contents of a bank depend on."""
    without = set() if config.bank.worlds else {"world_groups"}
    without |= {"folder", "seed", "max_gib", "worlds", "others", "sweep"}
    bank = config.bank.model_dump(mode="json", exclude=without)
    if network.unet.hints:
        bank |= {"hints": describe_sweep(config.bank.sweep or default_sweep_path())["sha256"]}
    network_document = json.loads(network.to_json())["autoencoder"]
    wanted = config.autoencoder.model_dump(mode="json")
    return {"bank": bank, "image_size": network.image_size, "seed": bank_seed(config), "network": network_document,
            "autoencoder": wanted}  # fmt: skip


def claim(path: Path, document: dict[str, Any], binding: Collection[str]) -> None:
    """Record in `path` what its folder holds. Raises ConfigError if an entry of those in `binding`, on which something
    in the folder depends already, is another one."""
    if path.exists():
        earlier = json.loads(path.read_text())
        changed = [name for name in document if name in binding and document[name] != earlier.get(name)]
        if changed:
            raise ConfigError(
                f"{path} belongs to a training with other settings ({', '.join(changed)}); go on with the same, or "
                "choose another folder."
            )
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_suffix(".partial")
    partial.write_text(json.dumps(document, indent=1))
    partial.replace(path)


def get_autoencoder(
    config: TrainRunConfig, network: ModelConfig, out: Path, photos: torch.Tensor | None, own: Ranks
) -> Autoencoder:
    """The autoencoder kept in `out`; before that the given one, the shipped model's, or one trained by rank 0.

    Raises ConfigError for a file whose autoencoder is not the one asked for."""
    path, wanted = out / AUTOENCODER, config.autoencoder
    if own.first and not path.exists():
        autoencoder, source = _ready_made(config, network)
        pictures = renders.rendered_images(out, 4096)
        if autoencoder is None:
            source = f"trained for {wanted.minutes:g} minutes"
            with meter("train the autoencoder", round(60 * wanted.minutes)) as bar:
                autoencoder = train_autoencoder(
                    new_autoencoder(network.autoencoder, pictures, photos, bank_seed(config)), pictures, photos,
                    60 * wanted.minutes, wanted.batch, wanted.learning_rate, bank_seed(config), own.device,
                    report=lambda passed, numbers: bar.update(
                        round(passed * bar.total), f"{numbers['psnr']:.1f} dB"
                    ),
                )  # fmt: skip
        quality = reconstruction_psnr(autoencoder, pictures[-256:].float() / 255)
        save_autoencoder(path, autoencoder, {"source": source, "renders_psnr_db": quality})
        console.print(f"  autoencoder: {source}; {quality:.1f} dB on the bank's renders")
    own.barrier()
    return load_autoencoder(path)


def _ready_made(config: TrainRunConfig, network: ModelConfig) -> tuple[Autoencoder | None, str]:
    if config.autoencoder.path is not None:
        found = load_autoencoder(config.autoencoder.path)
        if found.config != network.autoencoder:
            raise ConfigError(
                f"autoencoder.path: {config.autoencoder.path} holds {found.config}, but the model asks for "
                f"{network.autoencoder}; set model.autoencoder to match, or leave the path out."
            )
        return found, f"from {config.autoencoder.path}"
    if config.autoencoder.shipped:
        with contextlib.suppress(FileNotFoundError):
            shipped = load_model(default_model_path()).autoencoder
            if shipped.config == network.autoencoder:
                return shipped, "of the shipped model"
    return None, ""


def read_photos(folder: Path) -> torch.Tensor:
    """Centre squares (M, 3, S, S) in [0, 1] of the .jpg files of a folder, in the order of their names."""
    paths = sorted(folder.glob("*.jpg"))
    if not paths:
        raise InputError(f"bank.textures: there are no .jpg photographs in {folder}.")
    return renders.squares([torch.from_numpy(read_image(p)[0].copy()).permute(2, 0, 1) for p in paths])
