"""Commands for those who train, measure and test: imported by `flows/cli.py`, which registers them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from flows.cli_app import OutOption, app


@app.command()
def train(
    config: Annotated[
        str, typer.Argument(help="A training's YAML file, or the name of a shipped preset (see --list).")
    ] = "",
    out: OutOption = Path("outputs/training"),
    list_: Annotated[bool, typer.Option("--list", help="List the shipped presets.")] = False,
    steps: Annotated[int | None, typer.Option(help="Optimizer steps, instead of the configuration's.")] = None,
    minutes: Annotated[float | None, typer.Option(help="Or the time spent in training.")] = None,
    autoencoder: Annotated[Path | None, typer.Option(help="Take the autoencoder of this file.")] = None,
    start: Annotated[Path | None, typer.Option(help="Weights to start from.")] = None,
    seed: Annotated[int | None, typer.Option(help="All randomness follows from it.")] = None,
    device: Annotated[str | None, typer.Option(help="auto, cpu or cuda.")] = None,
    bank_only: Annotated[bool, typer.Option("--bank-only", help="Only make what is trained on.")] = False,
    set_: Annotated[
        list[str] | None, typer.Option("--set", help="One setting, e.g. --set optimizer.groups=8. May be repeated.")
    ] = None,
) -> None:
    """Train a multi-view diffusion model on procedural scenes; run again, it goes on where it was stopped."""
    from flows.commands.train import train_command

    path = str(autoencoder) if autoencoder else None
    given: dict[str, Any] = {"steps": steps, "minutes": minutes, "seed": seed, "device": device}
    given |= {"start": str(start) if start else None} | ({"autoencoder": {"path": path}} if path else {})
    train_command(config, out, given, set_ or [], list_, bank_only)


@app.command()
def worlds(
    package: Annotated[Path, typer.Argument(help="Folder for Debian's supertuxkart-data; fetched if not there yet.")],
    held_out: Annotated[
        Path | None, typer.Option(help="Photograph the held-out tracks into this folder, to evaluate models on.")
    ] = None,
    groups: Annotated[int, typer.Option(help="How many held-out groups of cameras, at least.")] = 60,
    views: Annotated[int, typer.Option(help="Cameras of a held-out group.")] = 10,
    size: Annotated[int, typer.Option(help="Side of their pictures in pixels.")] = 128,
) -> None:
    """Fetch textured worlds to train on (628 MB, nothing is installed), and list their licences."""
    from flows.commands.worlds import worlds_command

    worlds_command(package, held_out, groups, views, size)


@app.command()
def stress(
    quick: Annotated[bool, typer.Option("--quick", help="Under a minute: a few thousand cases a routine.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON for machines.")] = False,
    only: Annotated[str, typer.Option(help="Only routines with this in their name, e.g. ssim or solvers.unipc.")] = "",
    seed: Annotated[int, typer.Option(help="Another seed searches elsewhere.")] = 0,
) -> None:
    """Search the worst relative error of every numerical routine; exit code 1 when a bound is broken."""
    from flows.commands.stress import stress_command

    stress_command(quick, as_json, only, seed)


@app.command()
def bench(
    name: Annotated[str, typer.Argument(help="A benchmark, or all; without it they are listed.")] = "",
    quick: Annotated[bool, typer.Option("--quick", help="Small sizes: all of them in minutes on two cores.")] = False,
    data: Annotated[Path | None, typer.Option(help="Folder of real scenes, for what needs them.")] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", "-o", help="Folder for benchmarks.md and benchmarks/NAME.parquet; docs/reference in a checkout."
        ),
    ] = None,
) -> None:
    """Run time against error for every stage: tables, fronts, and where the defaults stand on them."""
    from flows.commands.bench import bench_command

    raise typer.Exit(1 if bench_command(name, quick, data, out) else 0)
