"""Benchmark of the skips: time and quality of whole runs with none, each alone, the defaults, and all.

Every variant is a run of its own in one store per scene in `outputs/skips`, so that a measurement that was cut off
goes on where it stopped, and the report of that folder shows every run. Stages whose content key another variant has
are linked, with the time they took there: equal keys are equal results.
"""

from __future__ import annotations

import os
import resource
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

import pyarrow.parquet as pq

from flows.jobs.job import Job
from flows.jobs.request import Request, make_config
from flows.pipeline.keys import Step, stages_of
from flows.pipeline.runner import execute_stage, opened, run_missing
from flows.readers import read_capture
from flows.reconstruction.stored import Checkpoint
from flows.reporting.report import write_report
from flows.reporting.summary import number, summary_rows
from schemas.layout import LAYOUT, SCENE_STAGES
from schemas.scene_store import SceneStore
from schemas.skip import SkipConfig
from schemas.stages import StageRecord

FOLDER = Path("outputs/skips")
START, END = "<!-- tables: written by python -m flows.bench.skips -->", "<!-- end of tables -->"
FAMILIES = ("llff", "dtu", "co3d", "re10k", "mip360")
REAL = ("llff_fern", "fox", "mipnerf360_bonsai", "co3d_apple")
#: Longer side of real views in pixels, as in the sweep of real scenes.
SIDE = 100
#: What `cat3d run --method cat3d` does unless told otherwise, but for a shorter plan (80 views are one path of the
#: paper) and a shorter video.
BASE = ("method=cat3d", "plan.views=80", "render.path_views=24")
#: For each switch alone: half of the training, as in the sweeps of the repository.
SHORT_BASE = (*BASE, "reconstruct.overrides={iterations: 500, warmup_iterations: 50}")
QUICK_BASE = ("method=cat3d", "plan.views=10", "render.path_views=2", "reconstruct.preset=tiny")
#: What is measured alone, by family: switches that act where the path has a gap, and where captured views cover it.
#: (`guidance` changes nothing for the shipped model, whose file asks for none; `rays` acts on few views.)
ALONE = {
    "dtu": ("coverage", "rounds", "near_steps", "solver", "workers", "detail", "seen", "empty_space",
            "proposals", "lpips", "low_resolution", "plateau"),
    "re10k": ("covered_path",),
}  # fmt: skip
SWITCHES = tuple(SkipConfig.model_fields)
VARIANTS: dict[str, dict[str, bool]] = {
    "none": dict.fromkeys(SWITCHES, False),
    "all": dict.fromkeys(SWITCHES, True),
    "default": SkipConfig().model_dump(),
    **{f"only {name}": dict.fromkeys(SWITCHES, False) | {name: True} for name in SWITCHES},
}


def sources(data: Path | None, real: Sequence[str] = REAL) -> Iterator[tuple[str, str, tuple[str, ...]]]:
    """(set, source, settings) of each scene: the procedural families, and the real scenes that are in `data`."""
    for family in FAMILIES:
        yield "procedural", f"procedural:{family}/1?views=24&width=64&height=64", ()
    for name in real if data is not None else ():
        path = data / name  # type: ignore[operator]
        if path.is_dir():
            yield "real", str(path), (f"ingest.downscale={max(1.0, longer_side(path) / SIDE)}",)


def longer_side(scene: Path) -> int:
    """The longer side of the scene's first photo, in pixels."""
    from flows.media.files import image_size

    return max(image_size(read_capture(scene).paths[0]))


def rows(
    scenes: Sequence[tuple[str, str, tuple[str, ...]]], variants: Sequence[str], base: Sequence[str] = BASE,
    folder: Path = FOLDER,
) -> list[dict[str, Any]]:  # fmt: skip
    """One row per scene and variant, and one per set of scenes and variant with the means (scene "mean")."""
    measured = [
        {"set": group, "variant": variant} | run_row(make_job(source, variant, (*base, *own), folder))
        for variant in variants
        for group, source, own in scenes
    ]
    write_report(folder.resolve())
    return [row | against_none(row, measured) for row in [*measured, *means(measured)]]


def make_job(source: str, variant: str, settings: Sequence[str], folder: Path) -> Job:
    """A run with three training views, named after its variant."""
    switches = ", ".join(f"{name}: {str(on).lower()}" for name, on in VARIANTS[variant].items())
    texts = [*settings, f"skip={{{switches}}}", f"label={variant.replace(' ', '-')}"]
    return Request(source, folder.resolve(), ("3",), make_config({}, None, texts)).jobs()[0]


def run_row(job: Job) -> dict[str, Any]:
    """Do what is missing of a run, and measure it.

    seconds: of all its stages; cpu_seconds: of this process and its workers, which other jobs on the machine don't
    lengthen. evaluations: of the diffusion network. generated: views that were sampled.
    """
    with opened(job):
        run_missing(job, execute=measure)
    store = SceneStore.open(job.store_path)
    records = {stage.name: store.record(stage.name, job.run) for stage in stages_of(job)}
    spent = store.attrs["cpu_seconds"]
    found = [r for r in summary_rows(job.out, job.scene_id) if r["run"] == job.run][0]
    done = {stage: record for stage, record in records.items() if record is not None}
    return {
        "scene": job.scene_id,
        "seconds": sum(record.seconds for record in done.values()),
        "cpu_seconds": sum(spent[owner(job, stage)] for stage in done),
        "sample_seconds": sum(spent[owner(job, stage)] for stage in ("sample", "decode")),
        "reconstruct_seconds": spent[owner(job, "reconstruct")],
        "evaluations": int(done["sample"].work["evaluations"]),
        "generated": int(done["decode"].work["views"]),
        "steps": int(done["reconstruct"].work["steps"]),
        **{name: found[name] for name in ("psnr_db", "ssim", "lpips")},
    }


def measure(job: Job, step: Step) -> StageRecord:
    """Do a stage and note its CPU time, or take its result from another run."""
    store = SceneStore.open(job.store_path, "r+")
    record = linked(store, job, step)
    if record is None:
        Checkpoint(job, step.key).remove()  # a measured stage is done in one go
        started = cpu_seconds()
        record = execute_stage(job, step)
        note(store, job, step.stage, cpu_seconds() - started)
    return record


def owner(job: Job, stage: str) -> str:
    """Name under which a stage's CPU time is kept."""
    return stage if stage in SCENE_STAGES else f"{job.run}/{stage}"


def note(store: SceneStore, job: Job, stage: str, seconds: float) -> None:
    store.set_attrs(cpu_seconds=store.attrs.get("cpu_seconds", {}) | {owner(job, stage): seconds})


def cpu_seconds() -> float:
    """Of this process and its children that have ended."""
    usage = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(u.ru_utime + u.ru_stime for u in usage)


def linked(store: SceneStore, job: Job, step: Step) -> StageRecord | None:
    """Take the stage's result from another run that has one with the same key; its record, None if there is none."""
    if step.stage in SCENE_STAGES or step.stage == "evaluate":  # rows of metrics carry the run's name
        return None
    for name in store.runs():
        record = store.record(step.stage, name)
        if name == job.run or record is None or record.key != step.key:
            continue
        if store.run(name).attrs["job"]["config"]["skip"]["workers"] != job.config.skip.workers:
            continue  # the same result, but not the same time
        for spec in LAYOUT:
            if spec.stage == step.stage:
                link_arrays(store.folder / "runs" / name, store.folder / "runs" / job.run, spec.path.split("/", 2)[2])
        store.complete(step.stage, record, job.run)
        note(store, job, step.stage, store.attrs["cpu_seconds"][f"{name}/{step.stage}"])
        return record
    return None


def link_arrays(source: Path, target: Path, pattern: str) -> None:
    """Hard links of the arrays that match, and of the attributes of the groups above them."""
    for array in sorted(source.glob(f"{pattern}/zarr.json")):
        inner = array.parent.relative_to(source)
        shutil.rmtree(target / inner, ignore_errors=True)
        shutil.copytree(array.parent, target / inner, copy_function=os.link)
        for group in list(inner.parents)[:-1]:
            shutil.copy(source / group / "zarr.json", target / group / "zarr.json")


def means(measured: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows of means over the scenes of a set, for the variants that all scenes of the set were measured with."""
    out = []
    for group in dict.fromkeys(row["set"] for row in measured):
        members = [row for row in measured if row["set"] == group]
        scenes = {row["scene"] for row in members}
        for variant in dict.fromkeys(row["variant"] for row in members):
            chosen = [row for row in members if row["variant"] == variant]
            if {row["scene"] for row in chosen} == scenes:
                numbers = [n for n, v in chosen[0].items() if isinstance(v, (int, float)) and not isinstance(v, bool)]
                mean = {n: fmean(float(row[n]) for row in chosen) for n in numbers}
                out.append({"set": group, "variant": variant, "scene": "mean"} | mean)
    return out


def against_none(row: dict[str, Any], measured: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """How much faster than without skips, and what it cost: ratios of time, differences of PSNR and LPIPS."""
    same = [r for r in (*measured, *means(measured)) if (r["set"], r["scene"]) == (row["set"], row["scene"])]
    base = next((r for r in same if r["variant"] == "none"), None)
    if base is None:
        return {}
    new, old = row.get("lpips"), base.get("lpips")
    return {
        "speed_up": base["cpu_seconds"] / row["cpu_seconds"],
        "speed_up_wall": base["seconds"] / row["seconds"],
        "psnr_change_db": row["psnr_db"] - base["psnr_db"],
        "lpips_change": None if new is None or old is None else new - old,
    }


def tables(measured: Sequence[dict[str, Any]]) -> str:
    """Markdown: per set of scenes the means of each variant, and per scene everything skipped against nothing."""
    variant = (
        "| variant | CPU s | faster | sample | reconstruct | evaluations | views | steps | PSNR dB | change | LPIPS |"
    )
    lines = []
    for group in dict.fromkeys(row["set"] for row in measured):
        members = [row for row in measured if row["set"] == group]
        scenes = [row["scene"] for row in members if row["variant"] == "none" and row["scene"] != "mean"]
        lines += [f"Means of {group} ({', '.join(scenes)}):", "", variant, "|---" * 11 + "|"]
        for r in (r for r in members if r["scene"] == "mean"):
            cells = [r["variant"], number(r["cpu_seconds"], 1), f"{number(r.get('speed_up'), 2)}x"]
            cells += [number(r[name], 1) for name in ("sample_seconds", "reconstruct_seconds")]
            cells += [number(r[name], 0) for name in ("evaluations", "generated", "steps")]
            cells += [number(r["psnr_db"], 2), signed(r.get("psnr_change_db")), number(r.get("lpips"), 3)]
            lines.append(f"| {' | '.join(cells)} |")
        lines += [""]
    lines += ["Every scene, `none` and `default`:", ""]
    lines += ["| scene | CPU s | | faster | PSNR dB | | change | LPIPS | |", "|---" * 9 + "|"]
    rows: dict[tuple[str, str], dict[str, Any]] = {}
    for row in measured:  # a scene's whole runs come before its shortened ones
        if row["scene"] != "mean":
            rows.setdefault((row["scene"], row["variant"]), row)
    for scene in dict.fromkeys(scene for scene, _ in rows):
        if (scene, "none") in rows and (scene, "default") in rows:
            a, b = rows[scene, "none"], rows[scene, "default"]
            lines += [
                f"| {scene} | {a['cpu_seconds']:.1f} | {b['cpu_seconds']:.1f} | {b['speed_up']:.2f}x | "
                f"{a['psnr_db']:.2f} | {b['psnr_db']:.2f} | {b['psnr_change_db']:+.2f} | {number(a.get('lpips'), 3)} | "
                f"{number(b.get('lpips'), 3)} |"
            ]
    return "\n".join(lines)


def signed(change: float | None) -> str:
    """A difference for a table; a dash for what was not measured."""
    return "-" if change is None else f"{change:+.2f}"


def write_tables(page: Path, table: Path) -> None:
    """Put the tables of a Parquet file into the page, between its markers."""
    text = page.read_text(encoding="utf-8")
    before, rest = text.split(START)
    _, after = rest.split(END)
    found = tables(pq.ParquetFile(table).read().to_pylist())
    page.write_text(f"{before}{START}\n{found}\n{END}{after}", encoding="utf-8")


if __name__ == "__main__":
    write_tables(Path("docs/log/2026-11-28_skips.md"), Path("docs/reference/benchmarks/skips.parquet"))
