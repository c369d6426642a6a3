"""`cat3d results`: print the summary of an output folder, and compare it with another one."""

from __future__ import annotations

from pathlib import Path

from rich.table import Table

from flows.errors import InputError
from flows.progress import console
from flows.reporting.summary import number, summary_rows

#: What counts as worse, per metric: (name, sign of better, unit).
COMPARED = (("psnr_db", 1, "dB"), ("ssim", 1, ""), ("lpips", -1, ""))


def results_command(out: Path, against: Path | None, bound_db: float, bound_rest: float) -> int:
    """Print the summary; with `against`, the changes too. Returns the number of regressions beyond the bounds."""
    rows = summary_rows(out)
    if not rows:
        raise InputError(f"{out} holds no metrics; give the --out folder of a run or sweep.")
    table = Table("scene", "run", "protocol", "PSNR (dB)", "SSIM", "LPIPS", "backbone", "seconds", title=str(out))
    for r in rows:
        table.add_row(r["scene_id"], r["run"], r["protocol"], number(r["psnr_db"], 2), number(r["ssim"], 4),
                      number(r["lpips"], 4), r["backbone"], number(r["seconds"], 0))  # fmt: skip
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
        for name, sign, _ in COMPARED:
            if r[name] is None or before[name] is None:
                continue
            if name == "lpips" and r["backbone"] != before["backbone"]:
                continue  # distances of two networks are not comparable
            compared += 1
            change = 0.0 if r[name] == before[name] else r[name] - before[name]
            worse = -sign * change > (bound_db if name == "psnr_db" else bound_rest)
            regressions += worse
            digits = 2 if name == "psnr_db" else 4
            values = (number(before[name], digits), number(r[name], digits), f"{change:+.{digits}f}")
            table.add_row(r["scene_id"], r["run"], r["protocol"], name, *values, "[red]worse[/red]" if worse else "")
    console.print(table)
    if not compared:
        raise InputError(f"{out} and {against} have no run, scene and protocol in common.")
    console.print(f"{regressions} of {compared} numbers are worse by more than the bound.")
    return regressions
