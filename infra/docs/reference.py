"""Writes the reference pages that follow from the code: commands, settings, store layout, sweeps and presets.

python -m infra.docs.reference            # write them
python -m infra.docs.reference --check    # exit code 1 where a page is not what the code says
"""

from __future__ import annotations

import sys
import textwrap
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, get_args

import typer
from pydantic import BaseModel

from cat3d_core.metrics import measures
from cat3d_core.metrics.protocols import PROTOCOLS
from flows.cli import app
from schemas.config import RunConfig, SweepConfig
from schemas.layout import LAYOUT
from schemas.training import TrainRunConfig

FOLDER = Path(__file__).resolve().parents[2] / "docs" / "reference"
NOTE = "<!-- Written by `make docs` from {source}. Change it there. -->\n"


def commands() -> str:
    """Every command of `cat3d` with its arguments and options, from the command line's own help."""
    group = typer.main.get_command(app)
    lines = [NOTE.format(source="flows/cli.py"), "# Commands", ""]
    lines += wrapped(
        "What `cat3d COMMAND --help` says, on one page. Exit codes: 0 done, 1 something failed (a sentence says what, "
        "where, and what to do), 2 wrong usage."
    )
    for name, command in sorted(getattr(group, "commands", {}).items()):
        usage = " ".join([name, *(_usage(p) for p in command.params if p.param_type_name == "argument")])
        lines += ["", f"## cat3d {name}", "", *wrapped(_sentence(command.help)), ""]
        lines += [f"    cat3d {usage} [OPTIONS]", ""]
        for parameter in command.params:
            if parameter.name != "help":
                lines += bullet(
                    f"{_names(parameter)}: {_sentence(getattr(parameter, 'help', ''))}{_default(parameter)}"
                )
    return "\n".join(lines) + "\n"


def settings() -> str:
    """Every setting of a run, a sweep and a training with its default and meaning, from the schemas' docstrings."""
    lines = [NOTE.format(source="schemas/"), "# Settings", ""]
    lines += wrapped(
        "Every setting has a default. Give others in a file (`--config FILE.yaml`) or one at a time "
        "(`--set render.path_views=30`). Unknown names are refused."
    )
    for title, model in (("A run", RunConfig), ("A sweep", SweepConfig), ("A training", TrainRunConfig)):
        lines += ["", f"## {title}", ""]
        for prefix, section in _sections(model):
            if prefix:
                lines += ["", f"### {prefix}", ""]
            lines += [*wrapped(" ".join((section.__doc__ or "").split())), ""]
            for name, field in section.model_fields.items():
                if not _is_section(field.annotation):
                    lines += bullet(f"`{name}` = `{_value(field)}`: {_sentence(field.description or '')}")
    return "\n".join(lines) + "\n"


def store() -> str:
    """Every array of the scene store, from `schemas/layout.py`."""
    lines = [NOTE.format(source="schemas/layout.py"), "# The scene store", ""]
    lines += wrapped(
        "One Zarr v3 folder a scene. Each array carries the names of its dimensions, its unit and its meaning, so "
        '`xarray.open_zarr(STORE, group="captured")` and `xarray.open_datatree(STORE)` open it. A view is one chunk, '
        "checked by crc32c when it is read; a content key or a record is written after the data, and says that they "
        "are complete."
    )
    section = ""
    for spec in LAYOUT:
        above, _, name = spec.path.rpartition("/")
        if above != section:
            lines += ["", f"## {above}", ""]
            section = above
        dims = "free shape" if spec.dims is None else ", ".join(
            d.name if d.size is None else f"{d.name} = {d.size}" for d in spec.dims
        )  # fmt: skip
        unit = f" Unit: {spec.unit}." if spec.unit not in ("", "1") else ""
        writer = f" Written by {spec.stage}." if spec.stage else ""
        lines += bullet(f"`{name}`, {spec.dtype} ({dims}): {_sentence(spec.meaning)}{unit}{writer}")
    return "\n".join(lines) + "\n"


def metrics() -> str:
    """Every metric and what it needs, from `cat3d_core/metrics/measures.py`."""
    lines = [NOTE.format(source="cat3d_core/metrics/measures.py"), "# Metrics", ""]
    lines += wrapped(
        "Measured of every held-out view; a row of `metrics/*.parquet` is one view under one protocol. A *protocol* "
        "(`--set evaluate.protocols=[google]`) is the exact rules by which a published table measured: which window, "
        "range, rounding and mask. The paper's is `google`. A column is empty where what it needs is lacking; nothing "
        "is downloaded."
    )
    for metric in measures.METRICS:
        better = f"{metric.better.capitalize()} is better."
        unit = f" Unit: {metric.unit}." if metric.unit not in ("", "1") else ""
        text = f"`{metric.name}`: {_sentence(metric.meaning)} {better}{unit}"
        if metric.network is not None:
            text += f" The column `{metric.network.column}` names the network. {metric.network.missing}"
        lines += ["", f"## {metric.title}", "", *wrapped(text)]
    lines += ["", "## Protocols", ""]
    for name, protocol in PROTOCOLS.items():
        lines += bullet(f"`{name}`: {_sentence(protocol.source)}")
    return "\n".join(lines) + "\n"


#: File name -> what writes it.
PAGES: dict[str, Callable[[], str]] = {
    "commands.md": commands, "settings.md": settings, "store.md": store, "metrics.md": metrics,
}  # fmt: skip


def stale() -> list[str]:
    """Names of the pages that are not what the code says now."""
    return [n for n, page in PAGES.items() if not (FOLDER / n).exists() or (FOLDER / n).read_text() != page()]


def wrapped(text: str, indent: str = "") -> list[str]:
    """Lines of at most 98 characters."""
    return textwrap.wrap(text, 98, initial_indent=indent, subsequent_indent=indent, break_long_words=False) or [""]


def bullet(text: str) -> list[str]:
    """A list item, folded."""
    first, *rest = textwrap.wrap(text, 96, break_long_words=False, break_on_hyphens=False)
    return [f"- {first}", *(f"  {line}" for line in rest)]


def _sections(model: type[BaseModel], prefix: str = "") -> Iterator[tuple[str, type[BaseModel]]]:
    yield prefix, model
    for name, field in model.model_fields.items():
        if _is_section(field.annotation):
            yield from _sections(field.annotation, f"{prefix}.{name}".lstrip("."))  # type: ignore[arg-type]


def _is_section(annotation: Any) -> bool:
    return isinstance(annotation, type) and issubclass(annotation, BaseModel)


def _value(field: Any) -> str:
    value = field.get_default(call_default_factory=True)
    if field.is_required():
        return "(required)"
    return "none" if value is None else str(value).lower() if isinstance(value, bool) else str(value)


def _usage(parameter: Any) -> str:
    name = parameter.name.upper()
    return name if parameter.required else f"[{name}]"


def _names(parameter: Any) -> str:
    if parameter.param_type_name == "argument":
        return f"`{parameter.name.upper()}`"
    return ", ".join(f"`{name}`" for name in (*parameter.opts, *parameter.secondary_opts))


def _default(parameter: Any) -> str:
    value = parameter.default
    if parameter.required or value in (None, False, [], "") or callable(value) or get_args(value):
        return ""
    return f" Default: `{value}`."


def _sentence(text: str | None) -> str:
    text = " ".join((text or "").split())
    return text if not text or text.endswith((".", "?", "!")) else f"{text}."


def main() -> None:
    """Write the pages, or with `--check` say which are stale."""
    if "--check" in sys.argv:
        names = stale()
        if names:
            sys.exit(f"Stale reference pages: {', '.join(names)}. Write them with `make docs`.")
        return
    FOLDER.mkdir(parents=True, exist_ok=True)
    for name, page in PAGES.items():
        (FOLDER / name).write_text(page())


if __name__ == "__main__":
    main()
