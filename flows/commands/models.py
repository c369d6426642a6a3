"""`cat3d models`: the models that are installed, and what a size of the diffusion network amounts to."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import torch
from rich.markup import escape
from rich.table import Table

from cat3d_core.diffusion import SIZES, count_flops, count_parameters, describe
from cat3d_core.diffusion.memory import Need, multiview_need
from cat3d_core.matching.checkpoint import describe_sweep
from cat3d_core.seva import network as seva_network
from cat3d_core.seva.config import SevaConfig
from cat3d_core.seva.generator import seva_spec
from cat3d_core.weights import default_model_path, default_sweep_path
from flows.errors import InputError
from flows.generation.open import find_format, format_names, recognised
from flows.progress import console


def models_command(describe_size: str | None, model: Path | None, as_json: bool) -> None:
    """Print the installed models (and `model`), or describe a size of SIZES without making its weights."""
    if describe_size is not None:
        report = size_report(describe_size)
        print(json.dumps(report, indent=1)) if as_json else console.print(_pairs(report, f"size {describe_size}"))
        return
    reports = [model_report(path) for path in installed() + ([model] if model else [])] + sweeps()
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


def sweeps() -> list[dict[str, Any]]:
    """What the shipped plane sweep's file says of itself, where the installation carries it."""
    try:
        path = default_sweep_path()
    except FileNotFoundError:
        return []
    return [{"path": str(path), "bytes": path.stat().st_size, **describe_sweep(path)}]


def model_report(path: Path) -> dict[str, Any]:
    """What a model file says of itself. Raises InputError for a file that no generator recognises."""
    if not path.exists():
        raise InputError(f"There is no model file {path}.")
    name = recognised(path)
    if name != "cat3d":
        return {"path": str(path), "generator": name, **_spec_report(name, path)}
    try:
        facts = describe(path)
    except (OSError, ValueError) as error:
        raise InputError(f"{path} can't be used as a model: {error}") from None
    return {"path": str(path), "bytes": path.stat().st_size, **facts}


def _spec_report(name: str, path: Path) -> dict[str, Any]:
    try:
        spec = find_format(name).describe(path)
    except ValueError as error:
        raise InputError(f"{path} can't be used as a model: {error}") from None
    report: dict[str, Any] = {"terms": spec.terms} if spec.terms else {}
    report |= {"views": spec.views, "image_size": list(spec.image_size), "sha256": spec.identity}
    return report | {"memory_gib": _memory(spec.need)}


def size_report(name: str) -> dict[str, Any]:
    """Parameters, work and memory of one of the built-in sizes, or of SEVA, counted without allocating them."""
    if name == "seva":
        seva = SevaConfig()
        counts = seva_network.count_parameters(seva), seva_network.count_flops(seva, seva.views)
        need, document = seva_spec(seva).need, asdict(seva)
    elif name in SIZES:
        config = SIZES[name]
        counts = count_parameters(config.unet), count_flops(config.unet)
        need, document = partial(multiview_need, config), json.loads(config.to_json())
    else:
        raise InputError(f"There is no size {name}; the sizes are {', '.join([*SIZES, 'seva'])}.")
    numbers = {"unet_parameters": counts[0], "tflop_per_evaluation": counts[1] / 1e12}
    return {"size": name, **numbers, "memory_gib": _memory(need), "config": document}


def _memory(need: Callable[[int, torch.dtype], Need] | None) -> dict[str, float]:
    """GiB of weights and work for some numbers of groups sampled at once, by precision."""
    if need is None:
        return {}
    return {
        f"{groups} at once, {str(dtype).removeprefix('torch.')}": round(need(groups, dtype).total / 2**30, 1)
        for dtype in (torch.float32, torch.bfloat16)
        for groups in (1, 4)
    }


def _pairs(report: dict[str, Any], title: str) -> Table:
    table = Table("", "", title=title, show_header=False)
    for name, value in report.items():
        table.add_row(name, escape(json.dumps(value) if isinstance(value, (dict, list)) else str(value)))
    return table
