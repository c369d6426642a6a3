"""The inspection of a store for people: readable in a terminal of 80 columns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import groupby
from typing import Any

from rich.console import Group, RenderableType
from rich.table import Column, Table
from rich.text import Text

#: Longest name of an array that is printed whole.
NAME_WIDTH = 26


def as_text(report: Mapping[str, Any]) -> RenderableType:
    """The report of `inspect_store` as something rich prints."""
    head = Text(
        f"{report['path']}\nscene {report['scene_id']} of {report['dataset']}, schema {report['schema_version']}, "
        f"{size_text(report['bytes_stored'])} stored of {size_text(report['bytes'])}\n"
    )
    cameras = [Text(_camera_line(name, summary)) for name, summary in report["cameras"].items()]
    parts: list[RenderableType] = [head, _stage_table(report["stages"]), Text(), *cameras, Text()]
    parts.append(_array_table(report["arrays"]))
    parts += [Text(f"{p['kind']}: {p['message']}", style="red") for p in report["problems"]]
    if report["verified"]:
        count = sum(row.get("chunks_stored", 0) for row in report["arrays"])
        parts.append(Text(f"Every chunk was read ({count}): {'all good' if report['ok'] else 'damage was found'}."))
    return Group(*parts)


def one_array_text(row: Mapping[str, Any]) -> RenderableType:
    """The report of `inspect_array` as something rich prints: its storage, its numbers, a histogram of lines."""
    lines = [f"{row['path']}  {_shape(row)} {row['dtype']}"]
    if row["dimensions"]:
        lines.append(f"  dimensions   {', '.join(row['dimensions'])}")
    if row["meaning"]:
        lines.append(f"  meaning      {row['meaning']}" + (f" [{row['unit']}]" if row["unit"] else ""))
    lines.append(
        f"  stored       {size_text(row['bytes_stored'])} of {size_text(row['bytes'])}, "
        f"{row['chunks_stored']} of {row['chunks_total']} chunks of {'x'.join(map(str, row['chunks']))}, "
        f"{' '.join(row['codecs'])}"
    )
    if row["values"]:
        lines.append(f"  values       {', '.join(row['values'])}")
    numbers = row["statistics"]
    if numbers:
        lines.append(f"  not finite   {numbers['not_finite']} of {numbers['count']}")
        if "mean" in numbers:
            lines.append(f"  range        {numbers['least']:.6g} to {numbers['greatest']:.6g}")
            lines.append(f"  mean, spread {numbers['mean']:.6g}, {numbers['deviation']:.6g} (standard deviation)")
            most = max(count for *_, count in numbers["histogram"])
            for low, high, count in numbers["histogram"]:
                lines.append(f"  {low:>11.4g} to {high:<11.4g} {count:>10}  {'#' * round(30 * count / most)}")
    return Text("\n".join(lines))


def size_text(count: int) -> str:
    """A number of bytes as people say it."""
    for unit, factor in (("GB", 10**9), ("MB", 10**6), ("kB", 10**3)):
        if count >= factor:
            return f"{count / factor:.1f} {unit}"
    return f"{count} B"


def _array_table(rows: Sequence[dict[str, Any]]) -> Table:
    table = Table(Column("array", no_wrap=True), Column("shape", no_wrap=True), "type", "chunks", "stored")
    table.box, table.pad_edge = None, False
    for section, members in groupby(rows, lambda row: row["path"].rpartition("/")[0]):
        inside = list(members)
        table.add_row(f"{section}/")
        if section.endswith("/field") and not any("error" in row for row in inside):
            table.add_row(*_folded(inside))
            continue
        for row in inside:
            name = f"  {_short(row['path'].rpartition('/')[2])}"
            if "error" in row:
                table.add_row(name, Text(row["error"], style="red"))
            else:
                there = f"{row['chunks_stored']}/{row['chunks_total']}"
                table.add_row(name, _shape(row), row["dtype"], there, size_text(row["bytes_stored"]))
    return table


def _folded(rows: Sequence[dict[str, Any]]) -> tuple[str, str, str, str, str]:
    """All parameters of a field in one line."""
    kinds = ", ".join(sorted({row["dtype"] for row in rows}))
    there, wanted, stored = (
        sum(row[name] for row in rows) for name in ("chunks_stored", "chunks_total", "bytes_stored")
    )
    return "  parameters", f"{len(rows)} arrays", kinds, f"{there}/{wanted}", size_text(stored)


def _stage_table(rows: Sequence[dict[str, Any]]) -> Table:
    table = Table("stage", "state", "views", Column("seconds", justify="right"), "finished (UTC)")
    table.box, table.pad_edge = None, False
    for run, members in groupby(rows, lambda row: row["run"]):
        table.add_row(f"run {run}" if run else "scene")
        for row in members:
            state = "damaged record" if "error" in row else "complete" if row["complete"] else "not complete"
            if row["stale_because"]:
                state = f"stale: {row['stale_because']}"
            views = f"{row['views_done']}/{row['views_total']}" if "views_done" in row else ""
            seconds = f"{row['seconds']:.1f}" if row["complete"] else ""
            finished = row.get("finished_at", "")[:16].replace("T", " ")
            table.add_row(f"  {row['stage']}", state, views, seconds, finished)
    return table


def _camera_line(name: str, summary: Mapping[str, Any]) -> str:
    if "error" in summary:
        return f"cameras of {name}: {summary['error']}"
    if not summary["count"]:
        return f"cameras of {name}: none"
    sizes = ", ".join(f"{n} of {size}" for size, n in summary["sizes"].items())
    span = [high - low for low, high in zip(summary["extent_min"], summary["extent_max"], strict=True)]
    return (
        f"cameras of {name}: {sizes} px; focal length {_span(summary['focal_px'])} px, horizontal field of view "
        f"{_span(summary['fov_degrees']['horizontal'])} degrees; centres span "
        f"{' x '.join(f'{s:.3g}' for s in span)} scene units, farthest apart {summary['baseline_largest']:.3g}"
    )


def _shape(row: Mapping[str, Any]) -> str:
    return "x".join(map(str, row["shape"])) or "one value"


def _short(name: str) -> str:
    return name if len(name) <= NAME_WIDTH else f"{name[: NAME_WIDTH - 1]}…"


def _span(limits: list[float]) -> str:
    low, high = limits
    return f"{low:.4g}" if f"{low:.4g}" == f"{high:.4g}" else f"{low:.4g} to {high:.4g}"
