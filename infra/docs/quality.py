"""README's table of quality, between its markers, from the Parquet tables that a sweep left."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path
from typing import Any

from cat3d_core.metrics.seeds import Mean
from flows.reporting.published import PUBLISHED
from flows.reporting.seeds import NOISE, change, mean_of, seeds_of
from flows.reporting.summary import mean_text, summary_rows, timing_rows
from schemas.documents import write_bytes
from schemas.tables import TIMINGS, read_rows

START, END = "<!-- quality: written by make figures -->", "<!-- end of quality -->"
#: Methods compared: the reconstructor on the photos alone, and with generated views.
BASELINE, GENERATED = "zipnerf", "cat3d"
SPLIT = "3"
#: The paper's name of a data set that is shortened here.
PAPER_NAMES = {"re10k": "realestate10k", "mip360": "mipnerf360"}


def write_table(page: Path, sweep: Path) -> None:
    """Replace what stands between the markers of the page. Raises ValueError where the sweep lacks a method."""
    text = page.read_text(encoding="utf-8")
    before, rest = text.split(START)
    after = rest.split(END)[1]
    write_bytes(page, f"{before}{START}\n{table(sweep)}\n{END}{after}".encode())


def table(sweep: Path) -> str:
    """A row for each data set: PSNR (dB) of both methods and the gain, with errors over seeds, and the paper's gain."""
    found: dict[tuple[str, str], list[dict[str, Any]]] = defaultdict(list)
    for row in summary_rows(sweep):
        if row["split"] == SPLIT and row["protocol"] == "google" and row["psnr_db"] is not None:
            found[row["dataset"], row["method"]].append(row)
    datasets = [d for d in sorted({d for d, _ in found}) if found.get((d, BASELINE)) and found.get((d, GENERATED))]
    if not datasets:
        raise ValueError(f"{sweep} has no data set with {SPLIT} views of both {BASELINE} and {GENERATED}.")
    lines = ["| scene | photos alone | with generated views | gain | the paper's gain |", "|---|---|---|---|---|"]
    for dataset in datasets:
        alone, generated = (found[dataset, m] for m in (BASELINE, GENERATED))
        means = [mean_text(mean_of(rows, "psnr_db"), 1) for rows in (alone, generated)]
        gain = change(generated, alone, "psnr_db")
        cells = [dataset, *means, _signed(gain) if gain else "", _paper(dataset)]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join([*lines, "", *_caption(sweep, found)])


def _signed(gain: Mean) -> str:
    """A gain with its sign, and a mark where it is noise."""
    text = f"{gain.value:+.1f}" if gain.error is None else f"{gain.value:+.1f} ± {gain.error:.1f}"
    return f"{text} {NOISE}" if gain.certain is False else text


def _paper(dataset: str) -> str:
    name = PAPER_NAMES.get(dataset, dataset)
    known = {p["method"]: p["psnr_db"] for p in PUBLISHED if p["dataset"] == name and p["split"] == SPLIT}
    if not {"CAT3D", "Zip-NeRF*"} <= known.keys():
        return ""
    return f"{round(known['CAT3D'] - known['Zip-NeRF*'], 3):+.1f}"


def _caption(sweep: Path, found: dict[Any, Any]) -> list[str]:
    seeds = max(seeds_of(rows) for rows in found.values())
    dates = sorted({row["started_at"].date().isoformat() for row in read_rows(sweep / "timings", TIMINGS).to_pylist()})
    minutes = sum(row["total"] for row in timing_rows(sweep)) / 60
    over = (
        f"± is the standard error over {seeds} seeds, {NOISE} a gain within their noise"
        if seeds > 1
        else "one seed, so without ±"
    )
    return [
        f"PSNR in dB of held-out views with three photos; {over}.",
        f"Sweep `{_name(sweep)}` of {dates[-1]}, {minutes:.0f} minutes of its stages in all. The paper's gain",
        "is CAT3D over Zip-NeRF\\* in its Table 1: other scenes, larger images and a larger model.",
    ]


def _name(sweep: Path) -> str:
    import json

    file = sweep / "sweep.json"
    return json.loads(file.read_text(encoding="utf-8"))["name"] if file.exists() else sweep.name
