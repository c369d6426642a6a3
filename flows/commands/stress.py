"""`cat3d stress`: the worst relative error of every numerical routine, against its bound."""

from __future__ import annotations

import contextlib
import json
import math
import time
from dataclasses import asdict

import torch
import typer
from rich.table import Table

from cat3d_core.stress import ROUTINES, Finding, stress
from flows.progress import console, meter

QUICK_CASES, FULL_CASES = 1_000, 24_000  # per routine and dtype, times the routine's share
_THREADS = 1  # batches are small: more threads wait for each other longer than they work


def stress_command(quick: bool = False, as_json: bool = False, only: str = "", seed: int = 0) -> None:
    """Print the worst case of each routine whose name contains `only`; exit code 1 where a bound is broken."""
    routines = [routine for routine in ROUTINES if only in routine.name]
    if not routines:
        console.print(f"cat3d: no routine has '{only}' in its name; there are: {', '.join(r.name for r in ROUTINES)}.")
        raise typer.Exit(2)
    started, threads = time.monotonic(), torch.get_num_threads()
    torch.set_num_threads(_THREADS)
    try:
        total = sum(len(routine.bounds) for routine in routines)
        with contextlib.nullcontext() if as_json else meter("stress", total) as progress:
            findings = stress(
                routines, QUICK_CASES if quick else FULL_CASES, seed,
                lambda f: progress.advance(note=f.routine) if progress and f.kind == "value" else None,
            )  # fmt: skip
    finally:
        torch.set_num_threads(threads)
    seconds = time.monotonic() - started
    if as_json:
        rows = [_finite(asdict(finding)) | {"ok": finding.ok} for finding in findings]
        print(json.dumps({"findings": rows, "seconds": round(seconds, 1), "seed": seed}, indent=1))
    else:
        console.print(_table(findings))
        for finding in findings:
            if not finding.ok:
                console.print(f"{finding.routine} {finding.dtype} {finding.kind}: {_story(finding)}", markup=False)
        console.print(_summary(findings, seconds), markup=False)
    if not all(finding.ok for finding in findings):
        raise typer.Exit(1)


def _table(findings: list[Finding]) -> Table:
    table = Table("routine", "dtype", "of", *(), box=None, title="Worst relative error found", title_justify="left")
    for name in ("cases", "error", "bound"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("")
    for f in findings:
        verdict = "ok" if f.ok else "[red]BROKEN[/red]"
        table.add_row(
            f.routine.replace("[", r"\["), f.dtype, f.kind, f"{f.cases:,}", f"{f.error:.1e}", f"{f.bound:.0e}", verdict
        )
    return table


def _story(finding: Finding) -> str:
    if finding.fault:
        return finding.fault
    inputs = "; ".join(f"argument {name} = {values}" for name, values in finding.input.items())
    return f"relative error {finding.error:.3g} (bound {finding.bound:.0e}) at {inputs}"


def _summary(findings: list[Finding], seconds: float) -> str:
    cases = sum(f.cases for f in findings if f.kind == "value")
    broken = [f for f in findings if not f.ok]
    names = len({f.routine for f in findings})
    verdict = f"{len(broken)} bounds BROKEN" if broken else f"all {len(findings)} bounds hold"
    return f"{names} routines, {cases:,} cases in {seconds:.0f} s: {verdict}."


def _finite(row: dict) -> dict:
    """JSON has no infinity: an error without a number is written as a word."""
    return row | {"error": row["error"] if math.isfinite(row["error"]) else "not finite"}
