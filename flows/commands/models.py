"""`cat3d models`: the diffusion models that are installed, and what a size of the network amounts to."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from rich.table import Table

from cat3d_core.diffusion import SIZES, count_flops, count_parameters, describe
from cat3d_core.weights import default_model_path
from flows.errors import InputError
from flows.generation.open import format_names
from flows.progress import console


def models_command(describe_size: str | None, model: Path | None, as_json: bool) -> None:
    """Print the installed models (and `model`), or describe a size of SIZES without making its weights."""
    if describe_size is not None:
        report = size_report(describe_size)
        print(json.dumps(report, indent=1)) if as_json else console.print(_pairs(report, f"size {describe_size}"))
        return
    reports = [model_report(path) for path in installed() + ([model] if model else [])]
    if as_json:
        print(json.dumps(reports, indent=1))
        return
    if not reports:
        console.print("No model is installed; train one with `cat3d train`.")
    for report in reports:
        console.print(_pairs(report, report["path"]))
    console.print(f"Generators (sample.generator): {', '.join(format_names())}.")


def installed() -> list[Path]:
    """The shipped model's file, where the installation carries it."""
    try:
        return [default_model_path()]
    except FileNotFoundError:
        return []


def model_report(path: Path) -> dict[str, Any]:
    """What a model file says of itself. Raises InputError for a file that is no model of ours."""
    try:
        facts = describe(path)
    except (OSError, ValueError) as error:
        raise InputError(f"{path} can't be used as a model: {error}") from None
    return {"path": str(path), "bytes": path.stat().st_size, **facts}


def size_report(name: str) -> dict[str, Any]:
    """Parameters and work of one of the built-in sizes, counted without allocating them."""
    if name not in SIZES:
        raise InputError(f"There is no size {name}; the sizes are {', '.join(SIZES)}.")
    config = SIZES[name]
    return {
        "size": name,
        "unet_parameters": count_parameters(config.unet),
        "tflop_per_evaluation": count_flops(config.unet) / 1e12,
        "config": json.loads(config.to_json()),
    }


def _pairs(report: dict[str, Any], title: str) -> Table:
    table = Table("", "", title=title, show_header=False)
    for name, value in report.items():
        table.add_row(name, json.dumps(value) if isinstance(value, (dict, list)) else str(value))
    return table
