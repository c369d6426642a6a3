"""What an output folder's tables amount to: means per run, the paper's Table 1, seconds per stage. Nothing is measured
here."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from cat3d_core.metrics import measures
from cat3d_core.metrics.measures import Metric
from cat3d_core.metrics.seeds import Mean
from flows.jobs.metric_table import metric_table
from flows.progress import console
from flows.reporting.published import PUBLISHED
from flows.reporting.seeds import NOISE, change, mean_of, seeds_of
from flows.stages import STAGES
from schemas.layout import SCENE_STAGES
from schemas.tables import TIMINGS, read_rows

#: Rows of timings that belong to a stage: sampling for all runs of a sweep at once, before their own flows.
SAMPLED_AHEAD = "sample_ahead"


def summary_rows(out: Path, scene_id: str | None = None) -> list[dict[str, Any]]:
    """One row per (scene, run, protocol): means over held-out views and the networks that measured, the seconds of the
    run's stages."""
    metrics = read_rows(out / "metrics", metric_table()).to_pylist()
    seconds = {(t["scene_id"], t["run"]): t["total"] for t in timing_rows(out)}
    groups: dict[tuple[str, str, str], list[dict[str, Any]]] = defaultdict(list)
    for row in metrics:
        if scene_id is None or row["scene_id"] == scene_id:
            groups[row["scene_id"], row["run"], row["protocol"]].append(row)
    out_rows = []
    for (scene, run, protocol), members in sorted(groups.items()):
        first = members[0]
        out_rows.append(
            {
                "scene_id": scene, "run": run, "protocol": protocol, "dataset": first["dataset"],
                "method": first["method"], "split": first["split"], "seed": first["seed"], "views": len(members),
                "resolution": f"{first['width']}x{first['height']}", "masked": bool(first["masked"]),
                "seconds": seconds.get((scene, run)),
                **{n.column: first.get(n.column) or "" for n in measures.networks(measures.METRICS)},
                **{metric.name: mean([m.get(metric.name) for m in members]) for metric in measures.METRICS},
            }
        )  # fmt: skip
    return out_rows


def paper_metrics() -> list[Metric]:
    """Those of the paper's Table 1."""
    return [metric for metric in measures.METRICS if metric.in_paper]


def shown_metrics(rows: Sequence[dict[str, Any]]) -> list[Metric]:
    """The paper's, and those that were measured in any of the rows of the summary."""
    return [m for m in measures.METRICS if m.in_paper or any(r[m.name] is not None for r in rows)]


def missing_networks(rows: Sequence[dict[str, Any]]) -> list[str]:
    """A sentence for each metric that no row has for want of a network."""
    lacking = [m.network for m in measures.METRICS if m.network and not any(r[m.name] is not None for r in rows)]
    return [network.missing for network in dict.fromkeys(lacking)]


def title(metric: Metric) -> str:
    """The metric's name for people, with its unit where that isn't 1."""
    return metric.title if metric.unit == "1" else f"{metric.title} ({metric.unit})"


def measured(row: dict[str, Any], metric: Metric) -> str:
    """The metric's number in a row of the summary, with the network that measured it where one did."""
    text = number(row[metric.name], metric.digits)
    network = row[metric.network.column] if metric.network is not None and row[metric.name] is not None else ""
    return f"{text} ({network})" if network else text


def mean(values: Sequence[float | None]) -> float | None:
    """The mean of what was measured; None where nothing was."""
    known = [v for v in values if v is not None]
    return float(np.mean(known)) if known else None


def split_order(split: str) -> tuple[bool, int, str]:
    """Counts by size, then names."""
    return (not split.isdigit(), int(split) if split.isdigit() else 0, split)


def method_order(method: str) -> tuple[bool, str]:
    """The baseline first, then by name."""
    return (method != "zipnerf", method)


def paper_tables(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """The paper's Table 1 for each protocol: {"protocol", "splits", "datasets": [{"name", "rows"}]}.

    A row has "method", "published", "what" (scenes, size, networks), "cells", one per split: {metric: Mean or None} of
    the paper's metrics, or None, and "noise", one per split: the metrics in which our best method is no better by more
    than seeds explain. The paper's rows (its own scenes and sizes) stand above ours, under the protocol `google`, which
    is the paper's, or else under the first one.
    """
    tables = []
    protocols = sorted({r["protocol"] for r in rows}, key=lambda p: (p != "google", p))
    for protocol in protocols:
        own = [r for r in rows if r["protocol"] == protocol]
        splits = sorted({r["split"] for r in own}, key=split_order)
        datasets = []
        for dataset in sorted({r["dataset"] for r in own}):
            here = [r for r in own if r["dataset"] == dataset]
            published = [p for p in PUBLISHED if p["dataset"] == dataset] if protocol == protocols[0] else []
            entries = [
                _entry(m, True, "the paper's scenes", [p for p in published if p["method"] == m], splits)
                for m in dict.fromkeys(p["method"] for p in published)
            ]
            for method in sorted({r["method"] for r in here}, key=method_order):
                members = [r for r in here if r["method"] == method]
                entries.append(_entry(method, False, _what(members), members, splits))
                entries[-1]["noise"] = [_as_good([r for r in here if r["split"] == s], method) for s in splits]
            datasets.append({"name": dataset, "rows": [e for e in entries if any(e["cells"])]})
        tables.append({"protocol": protocol, "splits": splits, "datasets": datasets})
    return tables


def _entry(method: str, published: bool, what: str, members: Sequence[dict[str, Any]], splits: Sequence[str]) -> dict:
    cells: list[dict[str, Mean | None] | None] = []
    for split in splits:
        found = [m for m in members if m["split"] == split]
        if published:  # one number each, whatever it is a mean of
            cells.append({n.name: Mean(found[0][n.name]) for n in paper_metrics()} if found else None)
        else:
            cells.append({n.name: mean_of(found, n.name) for n in paper_metrics()} if found else None)
    return {"method": method, "published": published, "what": what, "cells": cells, "noise": [set() for _ in splits]}


def _as_good(rows: Sequence[dict[str, Any]], method: str) -> set[str]:
    """The paper's metrics in which the best method of these rows is another one, by no more than seeds explain."""
    found = set()
    own = [r for r in rows if r["method"] == method]
    for metric in paper_metrics():
        sign = 1 if metric.better == "higher" else -1
        means = {m: mean_of([r for r in rows if r["method"] == m], metric.name) for m in {r["method"] for r in rows}}
        known = {m: sign * value.value for m, value in means.items() if value is not None}
        best = max(known, key=lambda m: known[m], default=method)
        ahead = change([r for r in rows if r["method"] == best], own, metric.name) if best != method else None
        if ahead is not None and ahead.value and ahead.certain is False:
            found.add(metric.name)
    return found


def _what(members: Sequence[dict[str, Any]]) -> str:
    scenes, seeds = sorted({m["scene_id"] for m in members}), seeds_of(members)
    parts = [scenes[0] if len(scenes) == 1 else f"mean of {len(scenes)} scenes"]
    parts += [", ".join(sorted({m["resolution"] for m in members}))]
    parts += ["masked"] if any(m["masked"] for m in members) else []
    parts += [f"{seeds} seeds"] if seeds > 1 else []
    columns = [network.column for network in measures.networks(tuple(paper_metrics()))]
    return " · ".join([*parts, *sorted({m[column] for m in members for column in columns} - {""})])


def timing_rows(out: Path) -> list[dict[str, Any]]:
    """One row per (scene, run): seconds of the latest execution of each stage; shared stages count for every run."""
    latest: dict[tuple[str, str, str], dict[str, Any]] = {}
    ahead: dict[tuple[str, str, str], dict[str, Any]] = {}
    for row in sorted(read_rows(out / "timings", TIMINGS).to_pylist(), key=lambda r: r["started_at"]):
        owner = "" if row["stage"] in SCENE_STAGES else row["run"]
        latest[row["scene_id"], owner, row["stage"]] = row
        if row["stage"] == SAMPLED_AHEAD:
            ahead[row["scene_id"], row["run"], "sample"] = row
        elif row["stage"] == "sample":  # the first one after sampling ahead found the views; a later one made its own
            row["seconds"] += ahead.pop((row["scene_id"], row["run"], "sample"), {"seconds": 0.0})["seconds"]
    runs = sorted({(scene, run) for scene, run, _ in latest if run})
    out_rows = []
    for scene, run in runs:
        stages = {}
        for stage in STAGES:
            row = latest.get((scene, run if stage.per == "run" else "", stage.name))
            users = [(scene, run, other.name) for other in STAGES if stage.name in other.reads]
            if row and not (stage.passing and not latest.keys() & set(users)):
                stages[stage.name] = row["seconds"]
        method = next(r["method"] for (s, name, _), r in latest.items() if (s, name) == (scene, run))
        row = {"scene_id": scene, "run": run, "method": method, "stages": stages, "total": sum(stages.values())}
        out_rows.append(row)
    return out_rows


def method_times(timings: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Mean seconds of each stage over the runs of a method, in the order of the stages."""
    rows = []
    for method in sorted({t["method"] for t in timings}, key=method_order):
        own = [t for t in timings if t["method"] == method]
        stages = {s.name: sum(t["stages"].get(s.name, 0.0) for t in own) / len(own) for s in STAGES}
        stages = {s: v for s, v in stages.items() if v}
        rows.append({"method": method, "runs": len(own), "stages": stages, "total": sum(stages.values())})
    return rows


def shared_savings(timings: Sequence[dict[str, Any]]) -> dict[str, float]:
    """Seconds by stage that runs of one scene saved by sharing it: all but one of them found it done."""
    saved: dict[str, float] = {}
    for stage in SCENE_STAGES:
        for scene in {t["scene_id"] for t in timings}:
            users = [t["stages"][stage] for t in timings if t["scene_id"] == scene and stage in t["stages"]]
            saved[stage] = saved.get(stage, 0.0) + sum(users[1:])
    return {stage: seconds for stage, seconds in saved.items() if seconds}


def markdown(rows: Sequence[dict[str, Any]], tables: Sequence[dict[str, Any]]) -> str:
    """The tables as Markdown: the paper's layout, then every run."""
    lines = []
    for table in tables:
        columns = ["data set", "method", "what", *(f"{s} views" for s in table["splits"])]
        lines += [
            f"{' / '.join(map(title, paper_metrics()))}, protocol {table['protocol']}. In italics: the paper's, of "
            f"other scenes and sizes, LPIPS by another network. ± is the standard error over seeds; {NOISE} is as "
            "good as the best of ours within it.",
            "",
            _line(columns),
            "|" + "---|" * len(columns),
        ]
        for dataset in table["datasets"]:
            for e in dataset["rows"]:
                cells = [" / ".join(_cell(c, n)) if c else "-" for c, n in zip(e["cells"], e["noise"], strict=True)]
                style = "*" if e["published"] else ""
                styled = (f"{style}{c}{style}" for c in (e["method"], e["what"], *cells))
                lines.append(_line([dataset["name"], *styled]))
        lines.append("")
    columns = ["scene", "training views", "method", "seed", "protocol", "resolution", "test views"]
    shown = shown_metrics(rows)
    columns += [*map(title, shown), "seconds"]
    lines += [_line(columns), "|" + "---|" * len(columns)]
    for r in rows:
        values = [r[n] for n in ("scene_id", "split", "method", "seed", "protocol", "resolution", "views")]
        lines.append(_line([*values, *(measured(r, metric) for metric in shown), number(r["seconds"], 0)]))
    return "\n".join(lines) + "\n"


def _cell(row: dict[str, Mean | None], noise: set[str]) -> list[str]:
    marks = [f" {NOISE}" if metric.name in noise else "" for metric in paper_metrics()]
    return [mean_text(row[metric.name], metric.digits) + m for metric, m in zip(paper_metrics(), marks, strict=True)]


def _line(cells: Sequence[Any]) -> str:
    return "| " + " | ".join(map(str, cells)) + " |"


def number(value: float | None, digits: int) -> str:
    """A number for a table; a dash for what was not measured."""
    return "-" if value is None else f"{value:.{digits}f}"


def mean_text(mean: Mean | None, digits: int) -> str:
    """A mean for a table, with its error where that is known; a dash for what was not measured."""
    return "-" if mean is None else mean.text(digits)


def print_metrics(out: Path, scene_id: str) -> None:
    """Print the scene's rows of the summary."""
    rows = summary_rows(out, scene_id)
    shown = shown_metrics(rows)
    table = Table("run", "protocol", "test views", *map(title, shown), "seconds", title=scene_id)
    for r in rows:
        numbers = [*(measured(r, metric) for metric in shown), number(r["seconds"], 0)]
        table.add_row(r["run"], r["protocol"], str(r["views"]), *numbers)
    if table.row_count:
        console.print(table)
