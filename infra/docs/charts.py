"""Charts of the documents, drawn from tables that benchmarks and trainings left. Nothing is measured here."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pyarrow.parquet as pq
import torch
from matplotlib.figure import Figure

from cat3d_core.plan import PlanConfig, make_plan
from cat3d_core.synthetic.capture import random_cameras

Row = dict[str, Any]
_BLUE, _ORANGE, _GREY = "#1b6ca8", "#d1603d", "#888888"

matplotlib.rcParams |= {
    "svg.fonttype": "none",
    "svg.hashsalt": "cat3d",
    "font.size": 10,
    "axes.grid": True,
    "grid.alpha": 0.3,
}
matplotlib.rcParams |= {"axes.spines.top": False, "axes.spines.right": False}


def _rows(path: Path) -> list[Row]:
    """Rows of a Parquet or CSV table; numbers of a CSV are strings."""
    if path.suffix == ".parquet":
        return pq.ParquetFile(path).read().to_pylist()
    with path.open(encoding="utf-8", newline="") as lines:
        return list(csv.DictReader(lines))


def _figure(width: float, height: float, panels: int = 1) -> tuple[Figure, list[Any]]:
    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, list(figure.subplots(1, panels, squeeze=False)[0])


def skips(docs: Path) -> Figure:
    """Cost against quality of each switch alone, and of the defaults, on one scene (dtu, three photos)."""
    rows = _rows(docs / "reference/benchmarks/skips.parquet")
    rows = [r for r in rows if r["set"] == "dtu, each alone" and r["scene"] == "mean"]
    rows.sort(key=lambda r: -r["cpu_seconds"])
    figure, (cost, quality) = _figure(8.4, 4.2, 2)
    colours = [_BLUE if r["variant"].startswith("only") else _ORANGE for r in rows]
    for axis, column, name in ((cost, "cpu_seconds", "CPU seconds of the run"), (quality, "psnr_db", "PSNR (dB)")):
        values = [r[column] for r in rows]
        bars = axis.barh(range(len(rows)), values, color=colours)
        axis.bar_label(bars, fmt="%.0f" if column == "cpu_seconds" else "%.1f", padding=3, fontsize=9)
        axis.set(xlabel=name)
        axis.grid(axis="y", visible=False)
        axis.invert_yaxis()
    cost.set_yticks(range(len(rows)), [r["variant"] for r in rows])
    quality.set_yticks([])
    cost.set_xlim(0, 130)
    quality.set_xlim(22, 27)
    return figure


def learning_curve(docs: Path) -> Figure:
    """PSNR of samples of held-out scenes against groups of views seen, for the last two trainings of the model."""
    rows = _rows(docs / "log/learning_curve.csv")
    figure, (axis,) = _figure(6.4, 3.6)
    seen = 0
    for name in dict.fromkeys(r["training"] for r in rows):
        own = [r for r in rows if r["training"] == name]
        groups = [seen + int(r["groups"]) for r in own]
        axis.plot(groups, [float(r["psnr_db"]) for r in own], "o-", label=name)
        seen = groups[-1]
    axis.axhline(17.14, color=_GREY, ls="--", label="nearest given view, copied")
    axis.set(xlabel="groups of views seen at 128 pixels", ylabel="PSNR (dB)", ylim=(16.8, 21.6))
    axis.legend(fontsize=9, loc="center right")
    return figure


def ablations(docs: Path) -> Figure:
    """PSNR of the paper's ablations after 32,000 groups of views, one seed, two families."""
    rows = [r for r in _rows(docs / "log/ablations.csv") if r["groups"] == "32000"]
    figure, (axis,) = _figure(7.6, 3.4)
    for offset, family, colour in ((-0.2, "dtu", _BLUE), (0.2, "mip360", _ORANGE)):
        values = [float(r[f"{family}_psnr_db"]) for r in rows]
        bars = axis.barh([i + offset for i in range(len(rows))], values, 0.38, color=colour, label=family)
        axis.bar_label(bars, fmt="%.2f", padding=3, fontsize=9)
    axis.set_yticks(range(len(rows)), [r["model"] for r in rows])
    axis.invert_yaxis()
    axis.set(xlim=(16.4, 18.8), xlabel="PSNR of samples (dB); copying the nearest view gives 16.7 (dtu), 16.5 (mip360)")
    axis.grid(axis="y", visible=False)
    axis.legend(fontsize=9, loc="upper right")
    return figure


def scaling(docs: Path) -> Figure:
    """Calculated seconds of sampling a scene against the number of GPUs."""
    rows = _rows(docs / "log/scaling.csv")
    figure, (axis,) = _figure(6.4, 3.6)
    gpus = [int(r["gpus"]) for r in rows]
    for column, name in (("several_photos_s", "several photos: 720 views"), ("one_photo_s", "one photo: 80 views")):
        axis.loglog(gpus, [float(r[column]) for r in rows], "o-", label=name, base=2)
    axis.loglog(gpus, [360 / g for g in gpus], ls=":", color=_GREY, label="without limits", base=2)
    axis.set(xlabel="GPUs", ylabel="seconds to sample one scene (calculated)", ylim=(1, 512))
    axis.set_xticks(gpus, [f"{g:,}" for g in gpus])
    axis.set_yticks([1, 4, 16, 64, 256], ["1", "4", "16", "64", "256"])
    axis.legend(fontsize=9)
    return figure


#: The family of procedural scenes whose captured cameras each recipe is drawn for, and how many of them.
_CAPTURED_FOR = {
    "single_spiral": ("llff", 1), "single_orbit": ("dtu", 1), "realestate10k": ("re10k", 3), "llff": ("llff", 3),
    "dtu": ("dtu", 3), "co3d": ("co3d", 3), "mipnerf360": ("mip360", 9),
}  # fmt: skip


def trajectories(docs: Path) -> Figure:
    """The views that each recipe plans, from above and from the side, for cameras such as it is chosen for."""
    figure = Figure(figsize=(11, 4.2), layout="constrained")
    axes = figure.subplots(2, len(_CAPTURED_FOR))
    for column, (recipe, (family, count)) in enumerate(_CAPTURED_FOR.items()):
        known = random_cameras(family, 1, 24, 64, 64)
        captured = known[torch.linspace(0, len(known) - 1, count).round().long()]
        captured = captured.to(dtype=torch.float64)
        plan = make_plan(captured, PlanConfig(recipe, count=240, image_size=64))
        views, given = (plan.frame.local(c.centers).numpy() for c in (plan.cameras, captured))
        every = np.concatenate([views, given, np.zeros((1, 3))])
        middle, reach = (every.max(0) + every.min(0)) / 2, 0.58 * np.ptp(every, 0).max()
        for axis, (a, b), name in ((axes[0, column], (0, 1), "above"), (axes[1, column], (1, 2), "the side")):
            axis.scatter(views[:, a], views[:, b], s=3, c=plan.path.numpy(), cmap="viridis")
            axis.scatter(given[:, a], given[:, b], s=26, c="#d62728", zorder=3)
            axis.plot(0, 0, "k+", markersize=9)
            axis.set(aspect="equal", xticks=[], yticks=[], xlim=(middle[a] - reach, middle[a] + reach))
            axis.set(ylim=(middle[b] - reach, middle[b] + reach))
            if column == 0:
                axis.set_ylabel(f"seen from {name}")
        axes[0, column].set_title(f"{recipe}\n{count} photo{'s' if count > 1 else ''}", fontsize=10)
    return figure


#: File in docs/figures -> how it is drawn from the documents' tables.
CHARTS: dict[str, Callable[[Path], Figure]] = {
    "skips.svg": skips,
    "learning_curve.svg": learning_curve,
    "ablations.svg": ablations,
    "scaling.svg": scaling,
    "trajectories.png": trajectories,
}
