"""The results of a folder as a table that one can sort."""

from __future__ import annotations

import html
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flows.reporting.summary import measured, number, shown_metrics, summary_rows, title


@dataclass(frozen=True)
class ResultTable:
    """rows: of each run of each scene the numbers by column, as text and as what to sort by; runs: the name of each
    row's run, as the viewer opens it."""

    columns: tuple[str, ...]
    rows: tuple[dict[str, tuple[str, Any]], ...]
    runs: tuple[str, ...]

    def order(self, column: str, rising: bool) -> list[int]:
        """The rows sorted by a column; those without a number there come last."""
        known = [i for i, row in enumerate(self.rows) if row[column][1] is not None]
        unknown = [i for i, row in enumerate(self.rows) if row[column][1] is None]
        return sorted(known, key=lambda i: self.rows[i][column][1], reverse=not rising) + unknown

    def html(self, column: str, rising: bool) -> str:
        """The table sorted by a column, its rows numbered from 1."""
        head = "".join(f"<th style='text-align:left;padding:0 6px'>{html.escape(n)}</th>" for n in ("", *self.columns))
        body = ""
        for place, i in enumerate(self.order(column, rising), 1):
            cells = (str(place), *(self.rows[i][name][0] for name in self.columns))
            body += "<tr>" + "".join(f"<td style='padding:0 6px'>{html.escape(cell)}</td>" for cell in cells) + "</tr>"
        style = "font-size:12px;border-collapse:collapse;white-space:nowrap"
        return f"<div style='overflow:auto;max-height:130px'><table style='{style}'><tr>{head}</tr>{body}</table></div>"


def result_table(out: Path) -> ResultTable | None:
    """The table of a folder of runs, None where nothing is measured."""
    rows = summary_rows(out)
    if not rows:
        return None
    metrics = shown_metrics(rows)
    several = len({row["protocol"] for row in rows}) > 1
    texts = ("scene", "run", *(("protocol",) if several else ()))
    columns = (*texts, *(title(metric) for metric in metrics), "seconds")
    found = []
    for row in rows:
        cells: dict[str, tuple[str, Any]] = {"scene": (row["scene_id"],) * 2}
        cells |= {name: (row[name],) * 2 for name in texts[1:]}
        cells |= {title(metric): (measured(row, metric), row[metric.name]) for metric in metrics}
        found.append(cells | {"seconds": (number(row["seconds"], 0), row["seconds"])})
    return ResultTable(columns, tuple(found), tuple(run_name(row["scene_id"], row["run"]) for row in rows))


def run_name(scene: str, run: str) -> str:
    """What the viewer calls a run of a folder."""
    return f"{scene} / {run}"
