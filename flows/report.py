"""The report of an output folder: one self-contained HTML page, and the same tables as Markdown.

Everything comes from what runs left behind (stores, Parquet tables); nothing is computed again.
"""

from __future__ import annotations

import base64
import io
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, select_autoescape
from rich.table import Table

from flows.pictures import depth_picture, error_picture
from flows.progress import console
from flows.published import PUBLISHED
from schemas.layout import SCENE_STAGES, STAGES
from schemas.scene_store import Run, SceneStore
from schemas.tables import METRICS, TIMINGS, read_rows

VIEWS_SHOWN = 4
METRIC_NAMES = ("psnr_db", "ssim", "lpips")


def write_report(out: Path, only_if_changed: bool = False) -> Path:
    """Write report.html and report.md of the folder; returns the page. `only_if_changed` keeps a page that exists."""
    page = out / "report.html"
    if only_if_changed and page.exists():
        return page
    scenes = [scene_section(out, path) for path in sorted(out.glob("*.zarr"))]
    rows = summary_rows(out)
    environment = Environment(loader=PackageLoader("flows"), autoescape=select_autoescape(["html", "j2"]))
    context = {
        "title": out.name,
        "rows": rows,
        "published": [p for p in PUBLISHED if p["dataset"] in {r["dataset"] for r in rows}],
        "timings": timing_rows(out),
        "curve": quality_against_time(rows),
        "scenes": scenes,
    }
    page.write_text(environment.get_template("report.html.j2").render(context), encoding="utf-8")
    (out / "report.md").write_text(markdown_table(rows), encoding="utf-8")
    return page


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
        means: dict[str, float | None] = {}
        for name in METRIC_NAMES:
            values = [m[name] for m in members if m[name] is not None]
            means[name] = float(np.mean(values)) if values else None
        out_rows.append(
            {
                "scene_id": scene, "run": run, "protocol": protocol, "dataset": first["dataset"],
                "method": first["method"], "split": first["split"], "seed": first["seed"], "views": len(members),
                "resolution": f"{first['width']}x{first['height']}", "backbone": first["lpips_backbone"] or "",
                "masked": bool(first["masked"]), "seconds": seconds.get((scene, run)), **means,
            }
        )  # fmt: skip
    return out_rows


def timing_rows(out: Path) -> list[dict[str, Any]]:
    """One row per (scene, run): seconds of the latest execution of each stage; shared stages count for every run."""
    latest: dict[tuple[str, str, str], dict[str, Any]] = {}
    for row in read_rows(out / "timings", TIMINGS).to_pylist():
        owner = "" if row["stage"] in SCENE_STAGES else row["run"]
        key = (row["scene_id"], owner, row["stage"])
        if key not in latest or row["started_at"] > latest[key]["started_at"]:
            latest[key] = row
    runs = sorted({(scene, run) for scene, run, _ in latest if run})
    out_rows = []
    for scene, run in runs:
        stages = {}
        for stage in STAGES:
            row = latest.get((scene, "" if stage in SCENE_STAGES else run, stage))
            if row:
                stages[stage] = row["seconds"]
        out_rows.append({"scene_id": scene, "run": run, "stages": stages, "total": sum(stages.values())})
    return out_rows


def scene_section(out: Path, path: Path) -> dict[str, Any]:
    """What the page shows of one scene: pictures of some held-out views per run, decisions, versions."""
    store = SceneStore.open(path)
    runs = []
    for name in store.runs():
        run = store.run(name)
        decisions = {}
        for stage in STAGES:
            record = store.record(stage, name)
            if record and record.decisions:
                decisions[stage] = record.decisions
        drawing = out / store.scene_id / name / "plan.png"
        runs.append(
            {
                "name": name,
                "views": view_pictures(store, run) if store.record("render", name) else [],
                "decisions": decisions,
                "config": run.attrs.get("job", {}).get("config", {}),
                "plan": _embedded_file(drawing) if drawing.exists() else None,
                "video": f"{store.scene_id}/{name}/path.mp4",
                "curve": training_curve(run),
            }
        )
    return {"id": store.scene_id, "dataset": store.dataset, "runs": runs, "provenance": store.attrs["provenance"]}


def view_pictures(store: SceneStore, run: Run) -> list[dict[str, Any]]:
    """Truth, render, error and depth of up to VIEWS_SHOWN held-out views, as data URIs."""
    if "test" not in run.section("renders"):
        return []
    section = run.renders("test")
    views = section.read("view")
    names = store.captured.read("name")
    chosen = np.unique(np.linspace(0, len(views) - 1, min(VIEWS_SHOWN, len(views))).round().astype(int))
    out = []
    for i in chosen.tolist():
        truth = store.captured.read_image("image", int(views[i]))
        image = section.read_image("image", i)
        out.append(
            {
                "name": str(names[views[i]]),
                "truth": png_uri(truth),
                "render": png_uri(image),
                "error": png_uri(error_picture(image, truth)),
                "depth": png_uri(depth_picture(section.read_image("depth", i))),
            }
        )
    return out


def training_curve(run: Run) -> str | None:
    """Batch PSNR against seconds of training, as an SVG."""
    if "field" not in run or "record" not in run.field:
        return None
    record = run.field.read("record")
    return _plot([(record[:, 1], record[:, 3], "")], "seconds", "batch PSNR (dB)")


def quality_against_time(rows: list[dict[str, Any]]) -> str | None:
    """Mean PSNR of every run against its seconds, one colour per method, as an SVG."""
    by_method: dict[str, list[tuple[float, float]]] = defaultdict(list)
    for row in rows:
        if row["seconds"] and row["psnr_db"] is not None and np.isfinite(row["psnr_db"]):
            by_method[f"{row['method']} ({row['protocol']})"].append((row["seconds"], row["psnr_db"]))
    if not by_method:
        return None
    series = [(np.array([x for x, _ in p]), np.array([y for _, y in p]), name) for name, p in by_method.items()]
    return _plot(series, "seconds per run", "PSNR of held-out views (dB)", marker="o", line="")


def _plot(series, x_label: str, y_label: str, marker: str = "", line: str = "-") -> str:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5, 2.6), layout="constrained")
    axes = figure.subplots()
    for x, y, label in series:
        axes.plot(x, y, marker=marker, linestyle=line, label=label or None, linewidth=1)
    axes.set_xlabel(x_label)
    axes.set_ylabel(y_label)
    axes.grid(alpha=0.3)
    if any(label for _, _, label in series):
        axes.legend(fontsize=7)
    text = io.StringIO()
    figure.savefig(text, format="svg")
    svg = text.getvalue()
    return svg[svg.index("<svg") :]


def png_uri(image: np.ndarray) -> str:
    """(H, W, 3) uint8 as a data URI."""
    from matplotlib.image import imsave

    data = io.BytesIO()
    imsave(data, image, format="png")
    return "data:image/png;base64," + base64.b64encode(data.getvalue()).decode()


def _embedded_file(path: Path) -> str:
    return "data:image/png;base64," + base64.b64encode(path.read_bytes()).decode()


def markdown_table(rows: list[dict[str, Any]]) -> str:
    """The summary as a Markdown table."""
    columns = ["scene", "training views", "method", "seed", "protocol", "resolution", "test views"]
    columns += ["PSNR (dB)", "SSIM", "LPIPS", "seconds"]
    lines = ["| " + " | ".join(columns) + " |", "|" + "---|" * len(columns)]
    for r in rows:
        lpips = f"{number(r['lpips'], 3)} ({r['backbone']})" if r["lpips"] is not None else "-"
        cells = [r[n] for n in ("scene_id", "split", "method", "seed", "protocol", "resolution", "views")]
        cells += [number(r["psnr_db"], 2), number(r["ssim"], 3), lpips, number(r["seconds"], 0)]
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(lines) + "\n"


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
