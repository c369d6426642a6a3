"""The page of all benchmarks, from the Parquet tables of their last runs: Markdown, and each with a picture."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from flows.bench.fronts import Drawn, cell, drawn_panels, verdict
from flows.bench.registry import BENCHES
from flows.bench.rows import Row
from schemas.errors import StoreError

#: Columns that say where and when rows were measured; each benchmark has one value of them.
RUN_COLUMNS = ("bench", "quick", "machine", "date", "load", "bench_seconds", "versions")
MOST_ROWS = 40
COLUMNS = 2


def read_benches(folder: Path) -> dict[str, list[Row]]:
    """Name -> rows, without their null columns, for each benchmark with a table there. Raises StoreError."""
    out = {}
    for name in BENCHES:
        path = folder / f"{name}.parquet"
        if not path.exists():
            continue
        try:
            rows = pq.ParquetFile(path).read().to_pylist()
        except (pa.ArrowException, OSError) as error:
            raise StoreError(f"{path} is damaged ({error}): run `cat3d bench {name}` again.") from error
        out[name] = [{key: value for key, value in row.items() if value is not None} for row in rows]
    return out


def write_page(page: Path, folder: Path) -> None:
    """Write the Markdown `page` and a picture `folder/NAME.png` for each benchmark from the tables in `folder`."""
    benches = {name: rows for name, rows in read_benches(folder).items() if rows}
    drawn = {name: panels_of(name, rows) for name, rows in benches.items()}
    lines = ["# Benchmarks", "", f"Written by `cat3d bench` from the tables in `{folder.name}/`; don't edit.", ""]
    if any(drawn.values()):
        lines += [
            "In the pictures a line is a front: what no other setting beats in both cost and value. A star is",
            "the default, gold where it lies on the front.", "",
        ]  # fmt: skip
    for name, rows in benches.items():
        run = rows[0]
        size = ", the small sizes of `--quick`" if run["quick"] else ""
        lines += [f"## {name}", "", f"{_sentence(BENCHES[name].summary)}", ""]
        lines += [f"*{run['machine']}; {run['date']}; {run['load']}; {run['bench_seconds']:.0f} s{size}.*", ""]
        if drawn[name]:
            _draw(drawn[name], folder / f"{name}.png")
            lines += [f"![Cost against error or quality: {name}]({folder.name}/{name}.png)", ""]
        lines += [f"- {panel.title}: {text}" for panel in drawn[name] for text in verdict(panel)]
        lines += [""] if drawn[name] else []
        shown = worth_showing(rows, drawn[name])
        for constants, columns, body in tables(shown):
            if constants:
                lines += [", ".join(f"{k} {cell(v)}" for k, v in constants.items()) + ":", ""]
            lines += ["| " + " | ".join(columns) + " |", "|---" * len(columns) + "|"]
            lines += ["| " + " | ".join(cell(row.get(c)) for c in columns) + " |" for row in body] + [""]
        if len(shown) < len(rows):
            kept = f"`{folder.name}/{name}.parquet`"
            lines += [f"Shown are the fronts and the defaults; all {len(rows)} rows are in {kept}.", ""]
    for versions in dict.fromkeys(rows[0]["versions"] for rows in benches.values()):
        names = ", ".join(name for name, rows in benches.items() if rows[0]["versions"] == versions)
        lines += [f"Versions ({names}): {versions}.", ""]
    page.write_text("\n".join(lines), encoding="utf-8")


def panels_of(name: str, rows: list[Row]) -> list[Drawn]:
    """Every panel of a benchmark with its rows."""
    return [drawn for panel in BENCHES[name].panels for drawn in drawn_panels(panel, rows)]


def worth_showing(rows: list[Row], panels: list[Drawn]) -> list[Row]:
    """All rows if they fit on a page, else those on the fronts and the defaults, and those that no picture shows if
    they fit."""
    if len(rows) <= MOST_ROWS or not panels:
        return rows
    drawn = {id(row) for panel in panels for row in panel.rows}
    chosen = {id(row) for panel in panels for row in (*panel.front, *panel.defaults)}
    others = {id(row) for row in rows} - drawn
    chosen |= others if len(others) <= MOST_ROWS else set()
    return [row for row in rows if id(row) in chosen]


def tables(rows: list[Row]) -> list[tuple[Row, list[str], list[Row]]]:
    """(columns with one value, columns that vary, rows) for each set of columns that rows have; at least one column
    varies, so that a single row is shown whole."""
    groups: dict[tuple[str, ...], list[Row]] = {}
    for row in rows:
        groups.setdefault(tuple(name for name in row if name not in RUN_COLUMNS), []).append(row)
    out = []
    for columns, members in groups.items():
        same = {c for c in columns if len(members) > 1 and len({str(row[c]) for row in members}) == 1}
        varying = [c for c in columns if c not in same]
        out.append(({c: members[0][c] for c in columns if c in same}, varying or list(columns), members))
    return out


def _sentence(text: str) -> str:
    return text[0].upper() + text[1:] + "."


def _draw(panels: list[Drawn], path: Path) -> None:
    from matplotlib.figure import Figure

    columns = min(COLUMNS, len(panels))
    lines = math.ceil(len(panels) / columns)
    figure = Figure(figsize=(5.6 * columns, 4.4 * lines), layout="constrained")
    axes = figure.subplots(lines, columns, squeeze=False).flatten()
    for axis in axes[len(panels) :]:
        axis.axis("off")
    for axis, drawn in zip(axes, panels):
        panel = drawn.panel
        groups: dict[str, list[Row]] = {}
        for row in drawn.rows:
            groups.setdefault(" ".join(str(row.get(name)) for name in panel.series), []).append(row)
        for number, (name, members) in enumerate(groups.items()):
            points = [[row[column] for row in members] for column in (panel.cost, panel.value)]
            axis.scatter(*points, s=22, color=f"C{number % 10}", marker="osv^"[number // 10 % 4], label=name, alpha=0.8)
        front = [[row[column] for row in drawn.front] for column in (panel.cost, panel.value)]
        axis.plot(*front, color="0.3", lw=1, zorder=1, label="front")
        for row in drawn.defaults:
            on_front = drawn.has_on_front(row)
            axis.scatter(
                row[panel.cost], row[panel.value], s=190, marker="*", facecolor="gold" if on_front else "white",
                edgecolor="black", zorder=3, label="default, on the front" if on_front else "default, not on the front",
            )  # fmt: skip
        axis.set(title=drawn.title, xlabel=panel.cost, ylabel=panel.value)
        _scales(axis, drawn)
        axis.tick_params(which="both", labelsize=8)
        axis.grid(alpha=0.3)
        axis.legend(fontsize=7)
    figure.savefig(path, dpi=100)


def _scales(axis: Any, drawn: Drawn) -> None:
    """Logarithmic axes, but not for decibels and not where there is nothing but zeros."""
    for column, scale, limit in (
        (drawn.panel.cost, axis.set_xscale, axis.set_xlim),
        (drawn.panel.value, axis.set_yscale, axis.set_ylim),
    ):
        values = [row[column] for row in drawn.rows]
        if drawn.panel.higher_is_better and column == drawn.panel.value:
            continue
        if min(values) > 0:
            scale("log")
        elif max(values) > 0:
            smallest = min(v for v in values if v > 0)
            scale("symlog", linthresh=smallest)
            limit(-0.3 * smallest, 2 * max(values))
