"""What an output folder's tables amount to: means per run, the paper's Table 1, seconds per stage. Nothing is measured
here."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from flows.progress import console
from flows.reporting.published import PUBLISHED
from schemas.layout import SCENE_STAGES, STAGES
from schemas.tables import METRICS, TIMINGS, read_rows

METRIC_NAMES = ("psnr_db", "ssim", "lpips")
MORE_NAMES = ("clip_score", "depth_abs_rel", "surface_chamfer")
#: Rows of timings that belong to a stage: sampling for all runs of a sweep at once, before their own flows.
SAMPLED_AHEAD = "sample_ahead"


def summary_rows(out: Path, scene_id: str | None = None) -> list[dict[str, Any]]:
    """One row per (scene, run, protocol): means over held-out views, the seconds of the run's stages, what LPIPS is."""
    metrics = read_rows(out / "metrics", METRICS).to_pylist()
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
                "resolution": f"{first['width']}x{first['height']}", "backbone": first["lpips_backbone"] or "",
                "clip_network": first.get("clip_network") or "", "masked": bool(first["masked"]),
                "seconds": seconds.get((scene, run)),
                **{name: mean([m.get(name) for m in members]) for name in (*METRIC_NAMES, *MORE_NAMES)},
            }
        )  # fmt: skip
    return out_rows


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

    A row has "method", "published", "what" (scenes, size, LPIPS network) and "cells", one per split: {"psnr_db",
    "ssim", "lpips"} or None; ours are means over scenes and seeds. The paper's rows (its own scenes and sizes) stand
    above ours, under the protocol `google`, which is the paper's, or else under the first one.
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
            datasets.append({"name": dataset, "rows": [e for e in entries if any(e["cells"])]})
        tables.append({"protocol": protocol, "splits": splits, "datasets": datasets})
    return tables


def _entry(method: str, published: bool, what: str, members: Sequence[dict[str, Any]], splits: Sequence[str]) -> dict:
    cells = []
    for split in splits:
        found = [m for m in members if m["split"] == split]
        cells.append({n: mean([m[n] for m in found]) for n in METRIC_NAMES} if found else None)
    return {"method": method, "published": published, "what": what, "cells": cells}


def _what(members: Sequence[dict[str, Any]]) -> str:
    scenes, seeds = sorted({m["scene_id"] for m in members}), {m["seed"] for m in members}
    parts = [scenes[0] if len(scenes) == 1 else f"mean of {len(scenes)} scenes"]
    parts += [", ".join(sorted({m["resolution"] for m in members}))]
    parts += ["masked"] if any(m["masked"] for m in members) else []
    parts += [f"{len(seeds)} seeds"] if len(seeds) > 1 else []
    backbones = sorted({m["backbone"] for m in members} - {""})
    return " · ".join([*parts, *backbones])


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
            row = latest.get((scene, "" if stage in SCENE_STAGES else run, stage))
            if row and not (stage == "encode" and (scene, run, "sample") not in latest):
                stages[stage] = row["seconds"]
        method = next(r["method"] for (s, name, _), r in latest.items() if (s, name) == (scene, run))
        row = {"scene_id": scene, "run": run, "method": method, "stages": stages, "total": sum(stages.values())}
        out_rows.append(row)
    return out_rows


def method_times(timings: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Mean seconds of each stage over the runs of a method, in the order of the stages."""
    rows = []
    for method in sorted({t["method"] for t in timings}, key=method_order):
        own = [t for t in timings if t["method"] == method]
        stages = {s: sum(t["stages"].get(s, 0.0) for t in own) / len(own) for s in STAGES}
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
            f"PSNR (dB) / SSIM / LPIPS, protocol {table['protocol']}. In italics: the paper's, of other scenes and "
            "sizes, LPIPS by another network.",
            "",
            _line(columns),
            "|" + "---|" * len(columns),
        ]
        for dataset in table["datasets"]:
            for e in dataset["rows"]:
                cells = [" / ".join(_cell(c)) if c else "-" for c in e["cells"]]
                style = "*" if e["published"] else ""
                styled = (f"{style}{c}{style}" for c in (e["method"], e["what"], *cells))
                lines.append(_line([dataset["name"], *styled]))
        lines.append("")
    columns = ["scene", "training views", "method", "seed", "protocol", "resolution", "test views"]
    columns += ["PSNR (dB)", "SSIM", "LPIPS", "seconds"]
    lines += [_line(columns), "|" + "---|" * len(columns)]
    for r in rows:
        lpips = f"{number(r['lpips'], 3)} ({r['backbone']})" if r["lpips"] is not None else "-"
        values = [r[n] for n in ("scene_id", "split", "method", "seed", "protocol", "resolution", "views")]
        lines.append(_line([*values, *_cell(r)[:2], lpips, number(r["seconds"], 0)]))
    return "\n".join(lines) + "\n"


def _cell(row: dict[str, Any]) -> list[str]:
    return [number(row["psnr_db"], 2), number(row["ssim"], 3), number(row["lpips"], 3)]


def _line(cells: Sequence[Any]) -> str:
    return "| " + " | ".join(map(str, cells)) + " |"


def number(value: float | None, digits: int) -> str:
    """A number for a table; a dash for what was not measured."""
    return "-" if value is None else f"{value:.{digits}f}"


def print_metrics(out: Path, scene_id: str) -> None:
    """Print the scene's rows of the summary."""
    table = Table("run", "protocol", "test views", "PSNR (dB)", "SSIM", "LPIPS", "seconds", title=scene_id)
    for r in summary_rows(out, scene_id):
        lpips = f"{number(r['lpips'], 3)} {r['backbone']}" if r["lpips"] is not None else "-"
        table.add_row(r["run"], r["protocol"], str(r["views"]), number(r["psnr_db"], 2), number(r["ssim"], 3), lpips,
                      number(r["seconds"], 0))  # fmt: skip
    if table.row_count:
        console.print(table)
