"""`cat3d train`: a configuration or a shipped preset becomes scenes, an autoencoder, a bank of latents and a model."""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from rich.table import Table

from cat3d_core.diffusion import count_parameters
from flows.errors import InputError
from flows.locks import writing
from flows.pipeline.versions import provenance
from flows.progress import console
from flows.training.loop import MODEL, SHEETS, STATE, TABLES, train
from flows.training.model import history, model_config, starting_config, starting_model
from flows.training.prepare import claim, prepare
from flows.training.ranks import Ranks, ranks
from flows.training.sheets import held_out
from flows.training.sweep import train_sweep
from flows.training.worlds import package as worlds
from schemas.config import load_config, parse_config
from schemas.errors import ConfigError
from schemas.settings import merged, settings_document
from schemas.sweep_training import Kind, SweepRunConfig
from schemas.tables import read_rows
from schemas.training import SAMPLES, TRAINING, TrainRunConfig

PRESETS = Path(__file__).parents[1] / "training" / "presets"
RECORD = "training.json"
#: Settings that may change between the legs of one training.
FREE = {"name", "note", "steps", "minutes", "device"} | {
    "log_steps", "save_minutes", "sample_minutes", "sample_scenes", "sample_steps",
}  # fmt: skip


def train_command(
    config: str, out: Path, given: dict[str, Any], settings: Sequence[str], list_presets: bool, bank_only: bool = False
) -> None:
    """Do what is not done yet of a training, or only of its bank. Raises InputError and ConfigError, in a sentence."""
    if list_presets or not config:
        for path in sorted(PRESETS.glob("*.yaml")):
            preset = load_config(path, kind_of(path))
            console.print(f"[bold]{path.stem}[/bold]  {preset.note}")
        return
    asked = training_config(config, given, settings)
    with _sentences(config), ranks(asked.device) as own:
        console.quiet = not own.first
        with _only_one(out, TABLES) if own.first else contextlib.nullcontext():
            if isinstance(asked, SweepRunConfig):
                train_sweep(asked, out, own, bank_only)
            else:
                run_training(asked, out, own, bank_only)


def kind_of(path: Path) -> type[TrainRunConfig] | type[SweepRunConfig]:
    """What a file configures, by its `kind`: a training of the plane sweep, or else of the diffusion model."""
    found = load_config(path, Kind).kind
    return SweepRunConfig if found == "sweep" else TrainRunConfig


def training_config(config: str, given: dict[str, Any], settings: Sequence[str]) -> TrainRunConfig | SweepRunConfig:
    """File or preset, then --set, then options. An option that ends the training (steps, minutes) replaces the
    other. Raises InputError for neither file nor preset, ConfigError for a bad field."""
    path = Path(config) if Path(config).is_file() else PRESETS / f"{config}.yaml"
    if not path.is_file():
        known = ", ".join(sorted(p.stem for p in PRESETS.glob("*.yaml")))
        raise InputError(f"{config} is neither a file nor a shipped preset; shipped are {known}.")
    kind = kind_of(path)
    document = load_config(path, kind).model_dump(mode="json")
    changes = merged(settings_document(settings), {name: value for name, value in given.items() if value is not None})
    if changes.get("steps") is not None:
        document["minutes"] = None
    elif changes.get("minutes") is not None:
        document["steps"] = None
    return parse_config(merged(document, changes), config, kind)


def run_training(config: TrainRunConfig, out: Path, own: Ranks, bank_only: bool = False) -> None:
    """Prepare what is trained on, train, say what came of it."""
    started = time.monotonic()
    network = starting_config(model_config(**config.model.model_dump()), config.start)
    if own.first and not bank_only:
        document = json.loads(config.model_dump_json())
        claim(out / RECORD, document, set(document) - FREE if (out / STATE).exists() else ())
    own.barrier()
    million = count_parameters(network.unet) / 1e6
    console.print(
        f"{config.name}: U-Net of {million:.1f} M parameters, {network.image_size} pixels, {own.world} x {own.device}"
    )
    folder = config.bank.folder or out
    with _only_one(folder, "bank") if own.first else contextlib.nullcontext():
        autoencoder, bank = prepare(config, network, folder, own)
    if bank_only:
        return
    scenes = held_out(config.bank.families, config.sample_scenes, network.image_size, max(8, network.views))
    model = starting_model(network, autoencoder, config.start, config.seed)
    families, textures = ", ".join(config.bank.families), config.bank.textures
    origin = {
        "data": f"procedural scenes of cat3d_core.synthetic ({families})"
        + (f", textures from {textures.name}" if textures else "")
        + (f", tracks of Debian's {worlds.PACKAGE}: {', '.join(worlds.TRAINING)}" if config.bank.worlds else ""),
        "training": json.loads(config.model_dump_json()), "versions": provenance(), "ranks": own.world,
    }  # fmt: skip
    if config.start is not None:
        origin["started_from"] = history(config.start)
    train(config, out, model, bank, scenes, own, origin)
    if own.first:
        _summary(out, time.monotonic() - started)


def _only_one(folder: Path, what: str) -> contextlib.AbstractContextManager[None]:
    return writing(folder / what, what)


@contextlib.contextmanager
def _sentences(source: str) -> Iterator[None]:
    """The core's errors about settings and files, with the configuration's name before them."""
    try:
        yield
    except (InputError, ConfigError):
        raise
    except (FileNotFoundError, FloatingPointError) as error:
        raise InputError(f"{source}: {error}") from error
    except ValueError as error:
        raise ConfigError(f"{source}: {error}") from error


def _summary(out: Path, seconds: float) -> None:
    """The last rows of both tables, and where things are."""
    rows, samples = read_rows(out / TABLES, TRAINING).to_pylist(), read_rows(out / SHEETS, SAMPLES).to_pylist()
    last = rows[-1]
    console.print(
        f"  {last['step']} steps, {last['groups']} groups in {last['seconds']:.0f} s of training; loss "
        f"{rows[0]['loss']:.3f} at first, {last['loss']:.3f} at last"
    )
    table = Table("family", "given", "sample, dB", "other views, dB", "nearest given view, dB", "matched")
    for one in (s for s in samples if s["step"] == last["step"]):
        names = ("psnr_right_db", "psnr_wrong_db", "psnr_nearest_db", "matched")
        cells = ["" if one[name] is None else f"{one[name]:.2f}" for name in names]
        table.add_row(one["family"], str(one["condition_views"]), *cells)
    console.print(table)
    console.print(f"Model: {out / MODEL}; sheets in {out / SHEETS}, tables in {out / TABLES}  ({seconds:.0f} s)")
