"""`cat3d bench`: measure, print, keep the rows as Parquet, and rewrite the page of all benchmarks."""

from __future__ import annotations

import os
import platform
import sys
import time
import traceback
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

import pyarrow as pa
import torch
from rich.box import SIMPLE
from rich.table import Column, Table

import cat3d_core
from flows.bench.fronts import cell, verdict
from flows.bench.page import panels_of, tables, worth_showing, write_page
from flows.bench.registry import BENCHES
from flows.bench.rows import MissingError, Row
from flows.errors import InputError, describe
from flows.jobs.device import cpu_count
from flows.pipeline.versions import provenance
from flows.progress import console
from schemas.tables import append_rows

TABLES = "benchmarks"


def bench_command(name: str, quick: bool, data: Path | None, out: Path | None) -> int:
    """Run one benchmark or `all`; rows to `out/benchmarks/<name>.parquet`, the page to `out/benchmarks.md`. Without a
    name, list them. `out` None: docs/reference in a checkout, else outputs. Returns the number of benchmarks that
    failed. One of several that lacks its data is left out, and its earlier rows stay on the page. Raises InputError for
    an unknown name."""
    if not name:
        for known, bench in BENCHES.items():
            console.print(f"[bold]{known}[/bold]  {bench.summary}")
        return 0
    if name != "all" and name not in BENCHES:
        raise InputError(f"{name} is not a benchmark; there are {', '.join(BENCHES)}, and all.")
    if data is not None and not data.is_dir():
        raise InputError(f"{data} is not a folder; --data takes the folder that holds the real scenes.")
    checkout = Path(cat3d_core.__file__).resolve().parents[1]
    out = out or Path("docs/reference" if Path.cwd() == checkout else "outputs")
    failed = 0
    for one in BENCHES if name == "all" else (name,):
        try:
            rows = measured(one, quick, data)
            keep(one, rows, out / TABLES)
            print_bench(one, rows)
        except MissingError as error:
            if name != "all":
                raise
            console.print(f"[bold]{one}[/bold]  left out. {error}")
        except Exception as error:  # the others still run
            failed += 1
            sentence = describe(error)
            if sentence is None:
                traceback.print_exc()
            print(f"cat3d: benchmark {one} failed: {sentence or repr(error)}", file=sys.stderr)
    if (out / TABLES).is_dir():
        write_page(out / f"{TABLES}.md", out / TABLES)
        console.print(f"Page: {out / TABLES}.md")
    return failed


def measured(name: str, quick: bool, data: Path | None) -> list[Row]:
    """The rows of one benchmark, each with the columns that say where, when and with what it was measured."""
    before, started = os.getloadavg()[0], time.perf_counter()
    with console.status(f"Benchmark {name}"):
        rows = BENCHES[name].run(quick, data)
    seconds, after = time.perf_counter() - started, os.getloadavg()[0]
    threads, cores = torch.get_num_threads(), cpu_count()
    busy = "; other jobs ran, so times are too long and unsteady" if max(before, after) > cores + 0.5 else ""
    run = {
        "bench": name,
        "quick": quick,
        "machine": machine(),
        "date": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "load": f"torch threads {threads}, load average {before:.1f} before and {after:.1f} after{busy}",
        "bench_seconds": seconds,
        "versions": ", ".join(f"{package} {version}" for package, version in provenance().items()),
    }
    return [dict(row) | run for row in rows]


def machine() -> str:
    """Processor, cores this process may use, memory, accelerator."""
    model = platform.processor() or platform.machine()
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        model = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), model)
    except OSError:
        pass
    cores = cpu_count()
    gpu = torch.cuda.get_device_name() if torch.cuda.is_available() else "no GPU"
    return f"{model}, {cores} cores, {platform.system()}, {gpu}"


def keep(name: str, rows: Sequence[Row], folder: Path) -> Path:
    """Replace the table of one benchmark; columns that some rows lack are null there."""
    columns = list(dict.fromkeys(column for row in rows for column in row))
    schema = pa.Table.from_pylist([{column: row.get(column) for column in columns} for row in rows]).schema
    return append_rows(folder, schema, rows, name)


def print_bench(name: str, rows: list[Row]) -> None:
    """The rows (or the fronts and defaults, where there are many) and a sentence about each default."""
    panels = panels_of(name, rows)
    shown = worth_showing(rows, panels)
    for constants, columns, body in tables(shown):
        caption = ", ".join(f"{key} {cell(value)}" for key, value in constants.items())
        table = Table(*(Column(c, overflow="fold") for c in columns), title=name, caption=caption, box=SIMPLE)
        for row in body:
            table.add_row(*(cell(row.get(column)) for column in columns))
        console.print(table)
    if len(shown) < len(rows):
        console.print(f"  the fronts and the defaults of {len(rows)} rows")
    for panel in panels:
        for sentence in verdict(panel):
            console.print(f"  {panel.title}: {sentence}")
    console.print(f"  {name}: {rows[0]['bench_seconds']:.0f} s" if rows else f"  {name}: no rows")
