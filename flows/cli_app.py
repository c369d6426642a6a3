"""The command line's parts that its files share: the application, and options that several commands have."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer(
    help="3D scenes from a handful of photos: an open, batch implementation of the CAT3D paper.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
)


def on_a_file_system(path: Path) -> Path:
    """The folder as it was given. Raises InputError for an address such as s3://bucket/folder."""
    from flows.errors import InputError
    from flows.object_storage import address_of

    if address := address_of(path):
        raise InputError(
            f"{address} is not on a file system, and this command needs a folder that is. Commands that take "
            "s3://BUCKET/FOLDER: run, sweep, reprocess, results, inspect, export."
        )
    return path


OutOption = Annotated[
    Path,
    typer.Option("--out", "-o", help="Folder for stores, tables, pictures and the report.", callback=on_a_file_system),
]
ResultsOption = Annotated[
    Path,
    typer.Option("--out", "-o", help="Folder for stores, tables, pictures and the report; also s3://BUCKET/FOLDER."),
]
DownscaleOption = Annotated[
    float | None, typer.Option(help="Divide image width and height by this; without it, by what the preset can use.")
]
SeedOption = Annotated[int, typer.Option(help="All randomness follows from it.")]
ReaderOption = Annotated[str, typer.Option(help="Layout of the folder; auto detects it.")]
ImagesOption = Annotated[str | None, typer.Option(help="Image folder inside the scene, where there are several.")]
SetOption = Annotated[list[str] | None, typer.Option("--set", help="One setting, e.g. plan.views=30. May be repeated.")]
ConfigOption = Annotated[Path | None, typer.Option(help="Settings from a YAML or JSON file; options here win.")]
