"""`cat3d results`: print the summary of an output folder, and compare it with another one."""

from __future__ import annotations

from pathlib import Path

from rich.table import Table

from cat3d_core.metrics import measures
from flows.errors import InputError
from flows.progress import console
from flows.reporting.summary import measured, number, shown_metrics, summary_rows, title


def results_command(out: Path, against: Path | None, bound_db: float, bound_rest: float) -> int:
    """Print the summary; with `against`, the changes too. Returns the number of regressions beyond the bounds."""
    rows = summary_rows(out)
    if not rows:
        raise InputError(f"{out} holds no metrics; give the --out folder of a run or sweep.")
    shown = shown_metrics(rows)
    table = Table("scene", "run", "protocol", *map(title, shown), "seconds", title=str(out))
    for r in rows:
        numbers = [*(measured(r, metric) for metric in shown), number(r["seconds"], 0)]
        table.add_row(r["scene_id"], r["run"], r["protocol"], *numbers)
    console.print(table)
    return compare(out, against, bound_db, bound_rest) if against else 0


def compare(out: Path, against: Path, bound_db: float, bound_rest: float) -> int:
    """Print the change of every number that both folders have, and count those that are worse beyond the bound."""
    old = {(r["scene_id"], r["run"], r["protocol"]): r for r in summary_rows(against)}
    if not old:
        raise InputError(f"{against} holds no metrics to compare with.")
    table = Table("scene", "run", "protocol", "metric", "before", "now", "change", "", title=f"against {against}")
    regressions = compared = 0
    for r in summary_rows(out):
        before = old.get((r["scene_id"], r["run"], r["protocol"]))
        if before is None:
            continue
        for metric in measures.METRICS:
            name = metric.name
            if r[name] is None or before[name] is None:
                continue
            if metric.network is not None and r[metric.network.column] != before[metric.network.column]:
                continue  # numbers of two networks are not comparable
            compared += 1
            change = 0.0 if r[name] == before[name] else r[name] - before[name]
            decline = -change if metric.better == "higher" else change
            worse = decline > (bound_db if metric.unit == "dB" else bound_rest)
            regressions += worse
            digits = metric.digits if metric.unit == "dB" else metric.digits + 1  # changes are smaller than numbers
            values = (number(before[name], digits), number(r[name], digits), f"{change:+.{digits}f}")
            table.add_row(r["scene_id"], r["run"], r["protocol"], name, *values, "[red]worse[/red]" if worse else "")
    console.print(table)
    if not compared:
        raise InputError(f"{out} and {against} have no run, scene and protocol in common.")
    console.print(f"{regressions} of {compared} numbers are worse by more than the bound.")
    return regressions
