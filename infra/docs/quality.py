"""README's table of quality, between its markers, from the Parquet tables that a sweep left."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path
from typing import Any

from cat3d_core.metrics.seeds import Mean
from flows.reporting.published import PUBLISHED
from flows.reporting.seeds import NOISE, change, mean_of, seeds_of
from flows.reporting.summary import mean_text, summary_rows
from infra.docs.reference import wrapped
from schemas.documents import write_bytes
from schemas.tables import TIMINGS, read_rows

START, END = "<!-- quality: written by make figures -->", "<!-- end of quality -->"
#: Methods compared: the reconstructor on the photos alone, and with generated views.
BASELINE, GENERATED = "zipnerf", "cat3d"
SPLIT = "3"
#: A family of scenes -> what its scenes are like, and the paper's name of the data set that it stands for.
FAMILIES = {
    "co3d": ("one object, from all around", "co3d"),
    "dtu": ("objects on a table, from one side", "dtu"),
    "llff": ("things before a wall, from the front", "llff"),
    "mipnerf360": ("open land, from all around", "mipnerf360"),
    "realestate10k": ("a room, walked through", "realestate10k"),
}


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
    lines = ["| procedural scene | photos alone | with generated views | gain | the paper's |", "|---|---|---|---|---|"]
    for dataset in datasets:
        alone, generated = (found[dataset, m] for m in (BASELINE, GENERATED))
        means = [mean_text(mean_of(rows, "psnr_db"), 1) for rows in (alone, generated)]
        gain = change(generated, alone, "psnr_db")
        name, published = FAMILIES.get(dataset, (dataset, dataset))
        cells = [name, *means, _signed(gain) if gain else "", _paper(published)]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join([*lines, "", *_caption(sweep, found)])


def _signed(gain: Mean) -> str:
    """A gain with its sign, and a mark where it is noise."""
    text = gain.text(1, signed=True)
    return f"{text} {NOISE}" if gain.certain is False else text


def _paper(dataset: str) -> str:
    """The paper's gain on the data set that the family stands for; empty where there is none."""
    known = {p["method"]: p["psnr_db"] for p in PUBLISHED if p["dataset"] == dataset and p["split"] == SPLIT}
    if not {"CAT3D", "Zip-NeRF*"} <= known.keys():
        return ""
    return f"{round(known['CAT3D'] - known['Zip-NeRF*'], 3):+.1f}"


def _caption(sweep: Path, found: dict[Any, Any]) -> list[str]:
    """What the numbers are of, in lines of at most 100 characters."""
    seeds = max(seeds_of(rows) for rows in found.values())
    scenes = max(len({row["scene_id"] for row in rows}) for rows in found.values())
    over = f"± is the standard error over {_words(seeds, 'seed')}" if seeds > 1 else "one seed, so without ±"
    text = (
        f"PSNR in dB of held-out views, three photos, {_words(scenes, 'scene')} a row; {over} (sweep `{_name(sweep)}`, "
        f"{_last_day(sweep)}). The paper's: CAT3D over Zip-NeRF\\* in its Table 1, on captured scenes of that kind "
        "with larger images and a larger model."
    )
    return wrapped(text)


def _last_day(sweep: Path) -> str:
    """The day of its last stage."""
    return max(row["started_at"].date().isoformat() for row in read_rows(sweep / "timings", TIMINGS).to_pylist())


def _words(count: int, of: str) -> str:
    """A small number in words, as prose has it."""
    numbers = ("no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine")
    return f"{numbers[count] if count < len(numbers) else count} {of}{'s' * (count != 1)}"


def _name(sweep: Path) -> str:
    import json

    file = sweep / "sweep.json"
    return json.loads(file.read_text(encoding="utf-8"))["name"] if file.exists() else sweep.name
