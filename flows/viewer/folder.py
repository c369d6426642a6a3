"""The results of a folder as a table that one can sort."""

from __future__ import annotations

import html
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flows.reporting.summary import measured, number, shown_metrics, summary_rows, title


@dataclass(frozen=True)
class ResultTable:
    """rows: of each run of each scene the numbers by column, as text and as what to sort by."""

    columns: tuple[str, ...]
    rows: tuple[dict[str, tuple[str, Any]], ...]

    def html(self, column: str, rising: bool) -> str:
        """The table sorted by a column; rows without a number there come last."""
        known = [row for row in self.rows if row[column][1] is not None]
        unknown = [row for row in self.rows if row[column][1] is None]
        ordered = sorted(known, key=lambda row: row[column][1], reverse=not rising) + unknown
        head = "".join(f"<th style='text-align:left;padding:0 6px'>{html.escape(name)}</th>" for name in self.columns)
        body = "".join(
            "<tr>" + "".join(f"<td style='padding:0 6px'>{html.escape(row[c][0])}</td>" for c in self.columns) + "</tr>"
            for row in ordered
        )
        style = "font-size:11px;border-collapse:collapse"
        return f"<div style='overflow:auto;max-height:240px'><table style='{style}'><tr>{head}</tr>{body}</table></div>"


def result_table(out: Path) -> ResultTable | None:
    """The table of a folder of runs, None where nothing is measured."""
    rows = summary_rows(out)
    if not rows:
        return None
    metrics = shown_metrics(rows)
    columns = ("scene", "run", *(title(metric) for metric in metrics), "seconds")
    found = []
    for row in rows:
        cells: dict[str, tuple[str, Any]] = {"scene": (row["scene_id"],) * 2, "run": (row["run"],) * 2}
        cells |= {title(metric): (measured(row, metric), row[metric.name]) for metric in metrics}
        found.append(cells | {"seconds": (number(row["seconds"], 0), row["seconds"])})
    return ResultTable(columns, tuple(found))
