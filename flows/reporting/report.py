"""The report of an output folder: one self-contained HTML page, and the same tables as Markdown.

Everything comes from what runs left behind (stores, Parquet tables). Only the splats of the scene that the page holds
are made, where none are kept from an earlier page or from the viewer.
"""

from __future__ import annotations

import base64
import io
import itertools
import json
import re
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, select_autoescape

from cat3d_core.view_selection import evenly
from flows.disk import naming_full_disk
from flows.jobs.metric_table import metric_table
from flows.media.pictures import depth_picture, error_picture
from flows.reporting.answer import answers, best_runs, rivals
from flows.reporting.charts import Point, Series, chart
from flows.reporting.seeds import NOISE, seeds_of
from flows.reporting.summary import (
    markdown,
    mean_text,
    method_order,
    method_times,
    missing_networks,
    number,
    paper_metrics,
    paper_tables,
    shared_savings,
    shown_metrics,
    split_order,
    summary_rows,
    timing_rows,
    title,
)
from flows.reporting.turning import PAGE_BYTES, turning_scene
from flows.stages import STAGES
from schemas.documents import write_bytes
from schemas.scene_store import Run, SceneStore
from schemas.tables import TIMINGS, read_rows

#: Held-out views shown of each run: all of a few, else this many.
VIEWS_SHOWN = 3
#: Of the stages in the time chart, in their order.
COLOURS = ("#8da0cb", "#e78ac3", "#a6d854", "#b15fd6", "#6f7fb5", "#fc8d62", "#ffd92f", "#66c2a5", "#b3b3b3", "#e5c494")
#: Scenes whose pictures stand at the top of the page, at most.
SCENES_ON_TOP = 12
REPORT, SWEEP, PROBLEMS = "report.html", "sweep.json", "problems.json"


def write_report(out: Path, only_if_changed: bool = False) -> Path:
    """Write report.html and report.md of the folder; returns the page. `only_if_changed` keeps a page that exists.
    Raises StoreError naming the disk where that is full."""
    page = out / REPORT
    if not (only_if_changed and page.exists()):
        with naming_full_disk(page):
            _write(out, page)
    return page


def _write(out: Path, page: Path) -> None:
    measured = read_rows(out / "metrics", metric_table()).to_pylist()
    scenes = [scene_section(out, path, measured) for path in sorted(out.glob("*.zarr"))]
    embed_scenes(out, scenes)
    rows, timings = summary_rows(out), timing_rows(out)
    tables = paper_tables(rows)
    sweep = _document(out / SWEEP) or {}
    environment = Environment(loader=PackageLoader("flows.reporting"), autoescape=select_autoescape(["html", "j2"]))
    environment.filters |= {"fixed": number, "mean": mean_text, "title": title}
    published = any(e["published"] for t in tables for d in t["datasets"] for e in d["rows"])
    context = {
        "title": sweep.get("name", out.name),
        "answers": answers(rows),
        "rivals": rivals(rows),
        "gallery": gallery(scenes, rows),
        "note": sweep.get("note", ""),
        "problems": _document(out / PROBLEMS) or [],
        "rows": rows,
        "psnr": {(r["scene_id"], r["run"]): r["psnr_db"] for r in rows},
        "tables": tables,
        "published": published,
        "noise": NOISE,
        "seeds": seeds_of(rows),
        "paper_metrics": paper_metrics(),
        "shown": shown_metrics(rows),
        "missing": missing_networks(rows),
        "timings": timings,
        "longest": max((t["total"] for t in timings), default=0.0),
        "methods": method_times(timings),
        "colours": dict(zip((s.name for s in STAGES), itertools.cycle(COLOURS))),
        "stages": [s.name for s in STAGES if any(s.name in t["stages"] for t in timings)],
        "shared": shared_savings(timings),
        "skipped": skipped_work(scenes),
        "curve": quality_against_time(rows),
        "scenes": scenes,
        "versions": versions(out, scenes),
        "sweep": sweep,
    }
    text = environment.get_template("report.html.j2").render(context)
    write_bytes(out / "report.md", markdown(rows, tables).encode())
    write_bytes(page, text.encode())  # last, and at once: `only_if_changed` takes a page that is there for a whole one


def gallery(scenes: Sequence[dict[str, Any]], rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """The first held-out view of each scene, of its best run in the split with the fewest photos: what the page shows
    before its tables. Each: the scene, the run, the view's number among those shown, and the run beside it or None."""
    splits = sorted({r["split"] for r in rows}, key=split_order)
    best, beside = (best_runs(rows, splits[0]) if splits else {}), rivals(rows)
    out = []
    for scene in scenes[:SCENES_ON_TOP]:
        name = best.get(scene["id"])
        shown = {run["name"] for run in scene["runs"] if run["views"]}
        if name is not None and name in shown:
            rival: str | None = beside.get((str(scene["id"]), str(name)))
            out.append({"scene": scene["id"], "run": name, "rival": rival if rival in shown else None})
    return out


def _document(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8")) if path.exists() else None


def scene_section(out: Path, path: Path, measured: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """What the page shows of one scene: pictures of some held-out views per run, decisions, versions. measured: rows
    of the metrics."""
    store = SceneStore.open(path)
    truths: dict[int, np.ndarray] = {}
    psnr = {(r["run"], r["view"]): r["psnr_db"] for r in reversed(measured) if r["scene_id"] == store.scene_id}
    runs = []
    for name in sorted(store.runs(), key=_run_order):
        run = store.run(name)
        records = {s.name: record for s in STAGES if (record := store.record(s.name, name))}
        folder = out / store.scene_id / name
        runs.append(
            {
                "name": name,
                "views": view_pictures(store, run, truths, psnr) if "render" in records else [],
                "decisions": {stage: record.decisions for stage, record in records.items() if record.decisions},
                "codes": {stage: record.code_version for stage, record in records.items()},
                "model": records["sample"].inputs.get("model", "") if "sample" in records else "",
                "terms": run.generated.attrs.get("terms", "") if "generated" in run else "",
                "config": run.attrs.get("job", {}).get("config", {}),
                "plan": _uri((folder / "plan.png").read_bytes()) if (folder / "plan.png").exists() else None,
                "video": f"{store.scene_id}/{name}/path.mp4" if (folder / "path.mp4").exists() else None,
                "curve": training_curve(run),
            }
        )
    return {
        "id": store.scene_id,
        "title": store.captured.attrs.get("title", store.scene_id),
        "dataset": store.dataset,
        "runs": runs,
        "provenance": store.attrs["provenance"],
    }


def embed_scenes(out: Path, scenes: Sequence[dict[str, Any]]) -> None:
    """Add to the first run of each scene what one needs to turn it in the page, as far as there is room; then to the
    further runs."""
    room = PAGE_BYTES
    for rank in range(max((len(scene["runs"]) for scene in scenes), default=0)):
        for scene in scenes:
            if rank < len(scene["runs"]):
                run = scene["runs"][rank]
                store = SceneStore.open(out / f"{scene['id']}.zarr")
                found = turning_scene(store, store.run(run["name"]), room)
                run["turning"] = found
                room -= found.get("bytes", 0) if found else 0


def _run_order(name: str) -> tuple:
    split, _, method = name.removeprefix("v").partition("-")
    return split_order(split), method_order(method)


def view_pictures(
    store: SceneStore, run: Run, truths: dict[int, np.ndarray], psnr: dict[tuple[str, int], float | None]
) -> list[dict[str, Any]]:
    """Truth, render, error and depth of up to VIEWS_SHOWN held-out views, as data URIs. truths: photos read so far;
    psnr: in dB, by run and view."""
    if "test" not in run.section("renders"):
        return []
    section = run.renders("test")
    views = section.read("view")
    names = store.captured.read("name")
    out = []
    for i in evenly(len(views), VIEWS_SHOWN):
        view = int(views[i])
        truth = truths.setdefault(view, store.captured.read_image("image", view))
        image = section.read_image("image", i)
        out.append(
            {
                "name": str(names[view]),
                "psnr": psnr.get((run.name, view)),
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
    points = [Point(float(seconds), float(psnr)) for _, seconds, _, psnr in run.field.read("record")]
    return chart([Series("", points)], "seconds of training", "PSNR of the batch (dB)", lines=True)


def quality_against_time(rows: Sequence[dict[str, Any]]) -> str | None:
    """Mean PSNR of every run against its seconds, one colour per method and protocol, as an SVG."""
    series: dict[str, list[Point]] = defaultdict(list)
    several = len({r["protocol"] for r in rows}) > 1
    for r in sorted(rows, key=lambda r: method_order(r["method"])):
        if r["seconds"] and r["psnr_db"] is not None:
            name = f"{r['method']} ({r['protocol']})" if several else r["method"]
            label = f"{r['scene_id']} {r['run']}: {r['psnr_db']:.2f} dB, {r['seconds']:.1f} s"
            series[name].append(Point(r["seconds"], r["psnr_db"], label))
    every = [Series(name, points) for name, points in series.items()]
    return chart(every, "seconds of the run's stages", "PSNR of held-out views (dB)", log_x=True)


def skipped_work(scenes: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Work that was not done: a row for each stage and switch (or sentence, numbers aside, where no switch did it),
    with the number of runs it is true of and what they saved together, by unit."""
    found: dict[tuple[str, str], dict[str, Any]] = {}
    for scene in scenes:
        for run in scene["runs"]:
            skips = [(s, d) for s, decisions in run["decisions"].items() for d in decisions if d.kind == "skipped"]
            for stage, decision in skips:
                kind = (stage, decision.switch or re.sub(r"[\d.,%]+", "#", decision.text))
                row = {"stage": stage, "switch": decision.switch or "", "sentence": decision.text, "runs": set()}
                entry = found.setdefault(kind, row | {"alike": False, "saved": defaultdict(float)})
                entry["runs"].add((scene["id"], run["name"]))
                entry["alike"] |= decision.text != entry["sentence"]
                for unit, count in decision.saved.items():
                    entry["saved"][unit] += count
    return [entry | {"runs": len(entry["runs"])} for entry in found.values()]


def versions(out: Path, scenes: Sequence[dict[str, Any]]) -> dict[str, list[str]]:
    """What made the results: packages, code versions of the stages, models, machines; several where scenes differ."""
    found: dict[str, set[str]] = defaultdict(set)
    for scene in scenes:
        for name, version in scene["provenance"].items():
            if name != "source":
                found[name].add(str(version))
        for run in scene["runs"]:
            for stage, version in run["codes"].items():
                found[f"stage {stage}"].add(str(version))
            if run["model"]:
                found["diffusion model"].add(f"sha256 {run['model'][:16]}")
    for row in read_rows(out / "timings", TIMINGS).to_pylist():
        found["machine"].add(f"{row['host']} ({row['device']})")
    return {name: sorted(values) for name, values in found.items()}


def png_uri(image: np.ndarray) -> str:
    """(H, W, 3) uint8 as a data URI."""
    from PIL import Image

    data = io.BytesIO()
    Image.fromarray(image).save(data, format="png")
    return _uri(data.getvalue())


def _uri(png: bytes) -> str:
    return "data:image/png;base64," + base64.b64encode(png).decode()
