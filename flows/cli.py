"""The command `cat3d`. Exit codes: 0 done, 1 something failed (the message says what), 2 wrong usage."""

from __future__ import annotations

import io
import os
import sys
from contextlib import nullcontext
from pathlib import Path
from typing import Annotated, Any

import typer

from flows.cli_app import (
    ConfigOption,
    DownscaleOption,
    ImagesOption,
    OutOption,
    ReaderOption,
    ResultsOption,
    SeedOption,
    SetOption,
    app,
)


@app.command()
def run(
    source: Annotated[str, typer.Argument(help="A scene's folder, or just photos, or procedural:FAMILY/SEED.")] = "",
    out: ResultsOption = Path("outputs"),
    prompt: Annotated[str, typer.Option(help="Text instead of a folder: what the scene's one photo shows.")] = "",
    text_to_image: Annotated[Path | None, typer.Option(help="Folder of a diffusers pipeline for --prompt.")] = None,
    text_settings: Annotated[str, typer.Option(help="Its settings, e.g. {steps: 20, guidance: 5, side: 512}.")] = "",
    views: Annotated[str, typer.Option(help="Training views: counts of a split, or all; several by commas.")] = "all",
    downscale: DownscaleOption = None,
    method: Annotated[str, typer.Option(help="zipnerf; cat3d: with generated views; auto: for one photo.")] = "auto",
    preset: Annotated[str, typer.Option(help="reconstruction preset: tiny, fast, balanced, paper.")] = "fast",
    seed: SeedOption = 0,
    model: Annotated[Path | None, typer.Option(help="Another generator than the shipped one: file or folder.")] = None,
    reader: ReaderOption = "auto",
    images: ImagesOption = None,
    config: ConfigOption = None,
    set_: SetOption = None,
) -> None:
    """Photos in, 3D scene out: renders, metrics and a report. Stages that are done already are not done again."""
    if bool(prompt) == bool(source) or bool(prompt) != (text_to_image is not None):
        raise typer.BadParameter("Give the scene's folder, or --prompt and --text-to-image.")
    from flows.commands.run import run_command
    from flows.jobs.request import make_request
    from flows.object_storage import results_at

    given: dict[str, Any] = {"downscale": downscale, "method": method, "preset": preset, "seed": seed}
    given |= {"model": str(model.resolve())} if model else {}
    with results_at(out) as folder:
        if text_to_image is not None:
            from flows.generation.text import make_prompt, text_to_photo

            source = str(text_to_photo(make_prompt(prompt, text_to_image, seed, text_settings), folder.resolve()))
        run_command(make_request(source, folder, views, given, reader, images, config, set_ or []))


@app.command()
def demo(
    out: OutOption = Path("outputs/demo"),
    smallest: Annotated[bool, typer.Option("--smallest", help="As small as it gets, for CI.")] = False,
) -> None:
    """One small procedural scene from nothing to a report, in minutes on two cores."""
    from flows.commands.run import demo_command

    demo_command(out, smallest)


@app.command()
def plan(
    source: Annotated[str, typer.Argument(help="A scene's folder, or procedural:FAMILY/SEED.")],
    out: OutOption = Path("outputs"),
    views: Annotated[str, typer.Option(help="Training views, as for run.")] = "all",
    trajectory: Annotated[str, typer.Option(help="auto, or a recipe such as single_orbit or co3d.")] = "auto",
    count: Annotated[int | None, typer.Option(help="Views to generate; without it the recipe's own number.")] = None,
    downscale: DownscaleOption = None,
    seed: SeedOption = 0,
    model: Annotated[Path | None, typer.Option(help="Plan for this model's file or folder.")] = None,
    reader: ReaderOption = "auto",
    images: ImagesOption = None,
    config: ConfigOption = None,
    set_: SetOption = None,
    rows: Annotated[int, typer.Option(help="Groups to print at most.")] = 24,
) -> None:
    """Which views would be generated, how they are grouped and on what they are conditioned: a table and a picture."""
    from flows.commands.plan import plan_command
    from flows.jobs.request import make_request

    given: dict[str, Any] = {"method": "cat3d", "downscale": downscale, "seed": seed}
    given |= {"trajectory": trajectory, "count": count}
    given |= {"model": str(model.resolve())} if model else {}
    plan_command(make_request(source, out, views, given, reader, images, config, set_ or []), rows)


@app.command()
def inspect(
    store: Annotated[Path, typer.Argument(help="A scene store (a .zarr folder).")],
    array: Annotated[str | None, typer.Argument(help="One of its arrays, such as captured/image.")] = None,
    png: Annotated[Path | None, typer.Option(help="Draw that array (images, depth, latents) or runs/RUN/plan.")] = None,
    verify: Annotated[bool, typer.Option("--verify", help="Read every chunk and check it.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON for machines.")] = False,
) -> None:
    """What a store holds: arrays, stages done, cameras, what is stale; or one array with its statistics."""
    from flows.commands.inspect import inspect_command
    from flows.object_storage import results_at

    with results_at(store, writes=False) as found:
        inspect_command(found, array, verify, as_json, png)


@app.command()
def export(
    store: Annotated[Path, typer.Argument(help="A scene store (a .zarr folder) with a finished run.")],
    run_name: Annotated[str | None, typer.Option("--run", help="The run, where the store has several.")] = None,
    what: Annotated[
        str, typer.Option(help="mesh, points, splats, dataset (these if not given), renders, plan; by commas.")
    ] = "",
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the exports.")] = Path("exports"),
    frame: Annotated[str, typer.Option(help="world: the data set's own; scene: normalised, +z up.")] = "world",
    resolution: Annotated[int, typer.Option(help="Voxels along each side of the mesh's cube.")] = 512,
    radius: Annotated[float, typer.Option(help="How far a surface reaches, in mean distances of the cameras.")] = 3.0,
    opacity: Annotated[float, typer.Option(help="Least opacity of a pixel that counts as surface.")] = 0.5,
    views: Annotated[int, typer.Option(help="Cameras to render for mesh, points and splats, at most.")] = 120,
    scale: Annotated[float, typer.Option(help="Their size relative to the photos.")] = 1.0,
    splats: Annotated[int, typer.Option(help="Splats, at most.")] = 200_000,
    refine: Annotated[int, typer.Option(help="Steps in which splats learn to look like the renders.")] = 500,
    path: Annotated[Path | None, typer.Option(help="Renders along it: a JSON path (docs/guides/viewing.md).")] = None,
) -> None:
    """A finished run as a mesh (PLY, GLB), points, splats (PLY, SPLAT, SPZ), a data set, or renders along any path."""
    from flows.commands.export import SurfaceSettings, export_command
    from flows.object_storage import results_at

    settings = SurfaceSettings(resolution, radius, opacity, views, scale, splats, refine)
    with results_at(store, writes=False) as found:
        export_command(found, run_name, what, out, frame, settings, path)


@app.command(name="import-views")
def import_views(
    store: Annotated[Path, typer.Argument(help="A scene store (a .zarr folder) with a plan.")],
    folder: Annotated[Path | None, typer.Argument(help="Folder with view_0000.png and so on.")] = None,
    run_name: Annotated[str | None, typer.Option("--run", help="The run, where several have a plan.")] = None,
    note: Annotated[str, typer.Option(help="What made the pictures, such as a model's name; it is recorded.")] = "",
    partial: Annotated[bool, typer.Option("--partial", help="Some planned views may be missing.")] = False,
    forget: Annotated[bool, typer.Option("--forget", help="Drop imported views; they are generated here.")] = False,
) -> None:
    """Pictures of a plan's views that any other program made (see export --what plan) become the run's."""
    from flows.commands.import_views import import_views_command

    if forget == (folder is not None):
        raise typer.BadParameter("Give a folder of pictures, or --forget.")
    import_views_command(store, folder, run_name, note, partial)


@app.command()
def view(
    path: Annotated[Path, typer.Argument(help="A scene store (a .zarr folder), or the folder of a run or sweep.")],
    run_name: Annotated[str | None, typer.Option("--run", help="The run that is shown first.")] = None,
    port: Annotated[int, typer.Option(help="Port to serve it at.")] = 8080,
    host: Annotated[str, typer.Option(help="Address to serve it on; all but loopback need a token.")] = "127.0.0.1",
) -> None:
    """Look at scenes in the browser: cameras, pictures, splats, the field itself; also while they are being made."""
    from flows.commands.view import view_command

    view_command(path, run_name, port, host)


@app.command()
def models(
    describe: Annotated[str | None, typer.Option(help="Describe a size: tiny, small, paper, seva.")] = None,
    model: Annotated[Path | None, typer.Option(help="Also show this model file.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON for machines.")] = False,
) -> None:
    """The diffusion models that are installed, and what the network's sizes amount to."""
    from flows.commands.models import models_command

    models_command(describe, model, as_json)


@app.command()
def sweep(
    config: Annotated[str, typer.Argument(help="A sweep's YAML file, or the name of a shipped one (see --list).")] = "",
    out: ResultsOption = Path("outputs/sweep"),
    list_: Annotated[bool, typer.Option("--list", help="List the shipped sweeps.")] = False,
    settings: Annotated[Path | None, typer.Option("--config", help="Settings of all runs from a file.")] = None,
    set_: SetOption = None,
) -> None:
    """Benchmark sweep: scenes x training views x methods x seeds. Run again, it fills in what is missing."""
    from flows.commands.sweep import list_sweeps, sweep_command
    from flows.object_storage import results_at

    if list_ or not config:
        list_sweeps()
        return
    with results_at(out) as folder:
        problems = sweep_command(config, folder, settings, set_ or [])
    raise typer.Exit(1 if problems else 0)


@app.command()
def reprocess(
    out: Annotated[Path, typer.Argument(help="The --out folder of an earlier run or sweep.")],
    split: Annotated[str | None, typer.Option(help="Only runs with these training views, e.g. 3.")] = None,
    from_: Annotated[str | None, typer.Option("--from", help="Redo this stage and all after it.")] = None,
    where: Annotated[
        list[str] | None, typer.Option(help="Only runs that match, e.g. scene=llff_* or method=cat3d. May be repeated.")
    ] = None,
    set_: Annotated[
        list[str] | None, typer.Option("--set", help="A setting to change in every run, e.g. reconstruct.preset=paper.")
    ] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only say what is stale, why, and what it costs.")] = False,
) -> None:
    """Redo what is stale after a change of images, cameras, splits, settings, code or model; nothing else."""
    from flows.commands.reprocess import reprocess_command
    from flows.object_storage import results_at
    from schemas.settings import settings_document

    with results_at(out, writes=not dry_run) as folder:
        problems = reprocess_command(folder, split, from_, where or [], settings_document(set_ or []), dry_run)
    for sentence in problems:
        print(f"cat3d: {sentence}", file=sys.stderr)
    raise typer.Exit(1 if problems else 0)


@app.command()
def results(
    out: Annotated[Path, typer.Argument(help="The --out folder of a run or sweep.")],
    against: Annotated[
        Path | None,
        typer.Option(help="Another folder: print changes; exit 1 where it was better beyond seeds' noise."),
    ] = None,
) -> None:
    """Print an output folder's numbers and compare them with another's."""
    from flows.commands.results import results_command
    from flows.object_storage import results_at

    other = results_at(against, writes=False) if against else nullcontext()
    with results_at(out, writes=False) as now, other as before:
        raise typer.Exit(1 if results_command(now, before) else 0)


import flows.cli_develop  # noqa: E402, F401  (registers its commands, after those above)


def main() -> None:
    """Entry point: errors a user can act on end in one sentence and exit code 1, without a traceback."""
    # Before torch and Prefect are imported: no busy-waiting threads on shared machines, no log lines between ours.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    os.environ.setdefault("PREFECT_LOGGING_LEVEL", "CRITICAL")
    os.environ.setdefault("PREFECT_LOGGING_INTERNAL_LEVEL", "CRITICAL")
    from flows.errors import describe

    for stream in (sys.stdout, sys.stderr):  # a terminal or pipe that lacks a letter shows ? for it
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    try:
        app()
    except (
        SystemExit
    ) as stop:  # typer makes 130 of Ctrl-C, flows/pipeline/server.py 143 of SIGTERM, both without a word
        if stop.code in (130, 143):
            print("Interrupted. What is stored stays; run the same command again to go on.", file=sys.stderr)
        raise
    except Exception as error:
        sentence = describe(error)
        if sentence is None:
            raise
        print(f"cat3d: {sentence}", file=sys.stderr)
        sys.exit(1)


if __name__ == "__main__":
    main()
