"""A plan to look at: top and side view as a picture, and a table."""

from __future__ import annotations

import io
from collections.abc import Sequence

import numpy as np
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from rich.table import Table

from cat3d_core.cameras import Cameras
from cat3d_core.plan import Plan
from cat3d_core.trajectories import SceneFrame

_CAPTURED, _ANCHOR, _POINTS = "#d62728", "#ff7f0e", "#bbbbbb"
_MAX_POINTS = 4000
# Columns of right, ahead, up coordinates that each view shows, and its axis names.
_VIEWS = (
    ("seen from above", (0, 1), ("right", "ahead")),
    ("seen from the side", (1, 2), ("ahead", "up")),
)


def draw_plan(captured: Cameras, plan: Plan, points: torch.Tensor | None = None, title: str = "") -> bytes:
    """PNG of the plan from above and from the side, in the scene's upright axes and units of its distance.

    Captured views red, anchors orange, the others coloured by index; a line shows each viewing direction. points
    (P, 3): scene points, drawn grey. The figure of the paper's appendix has the same colours. Raises ValueError for a
    stored plan that has lost its frame.
    """
    if (frame := plan.frame) is None:
        raise ValueError("This plan was stored without the scene's axes, by an older program: plan the scene again.")
    figure = Figure(figsize=(13, 6.2), layout="constrained")
    FigureCanvasAgg(figure)
    planned = _local(frame, plan.cameras)
    sources = _local(frame, captured)
    cloud = _some_points(frame, points)
    anchor = plan.anchor.numpy()
    index = np.arange(len(plan))
    for axes, (name, (a, b), labels) in zip(figure.subplots(1, 2), _VIEWS, strict=True):
        axes.scatter(cloud[:, a], cloud[:, b], s=1, c=_POINTS, zorder=0)
        center, toward = planned
        step = max(1, len(plan) // 240)  # every direction of a long plan would hide the path
        _directions(axes, center[::step], toward[::step], (a, b), "#00000030", 0.12)
        drawn = axes.scatter(center[:, a], center[:, b], s=6, c=index, cmap="viridis", zorder=2)
        axes.scatter(center[anchor, a], center[anchor, b], s=45, c=_ANCHOR, zorder=4, label="anchor")
        _directions(axes, *sources, (a, b), _CAPTURED, 0.2)
        axes.scatter(sources[0][:, a], sources[0][:, b], s=22, c=_CAPTURED, zorder=5, label="captured")
        axes.plot(0, 0, "k+", markersize=10, label="centre")
        axes.set(title=name, xlabel=labels[0], ylabel=labels[1], aspect="equal")
        reach = np.concatenate([center, sources[0], np.zeros((1, 3))])[:, [a, b]]
        low, high = reach.min(0) - 0.3, reach.max(0) + 0.3
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    figure.colorbar(drawn, ax=figure.axes, label="view index", shrink=0.7)
    figure.axes[0].legend(loc="best", fontsize=8)
    figure.suptitle(f"{title + ': ' if title else ''}{plan.recipe}, {len(plan)} views")
    out = io.BytesIO()
    figure.savefig(out, format="png", dpi=90)
    return out.getvalue()


def plan_table(plan: Plan, names: Sequence[str] | None = None, rows: int = 24) -> Table:
    """The plan's groups as a table, with the reasons and coverage as its caption.

    names: of the captured views. rows: at most so many groups are shown (first and last ones).
    """
    before, after = plan.captured_coverage, plan.plan_coverage
    table = Table(
        title=f"{plan.recipe}: {len(plan)} views in {len(plan.groups)} groups",
        caption="\n".join(
            [
                *plan.reasons,
                f"Voxels seen {before.seen:.0%} -> {after.seen:.0%}; directions per voxel {before.directions:.1f} -> "
                f"{after.directions:.1f}.",
            ]
        ),
        caption_justify="left",
    )
    for column in ("group", "kind", "path", "views", "conditioned on"):
        table.add_column(column)
    count = len(plan.groups)
    shown = range(count) if count <= rows else [*range(rows - rows // 3), *range(count - rows // 3, count)]
    previous = -1
    for g in shown:
        if g != previous + 1:
            table.add_row("...")
        previous = g
        group = plan.groups[g]
        path = sorted({int(plan.path[v]) for v in group.targets})
        table.add_row(
            str(g),
            "anchors" if group.anchors else group.kind,
            ", ".join(map(str, path)),
            _ranges(group.targets),
            ", ".join(_source(plan, condition, names) for condition in group.conditions),
        )
    return table


def _source(plan: Plan, condition: int, names: Sequence[str] | None) -> str:
    if condition >= plan.captured_count:
        return f"anchor {condition - plan.captured_count}"
    return names[condition] if names is not None else f"captured {condition}"


def _ranges(views: Sequence[int]) -> str:
    if len(views) > 1 and list(views) == list(range(views[0], views[-1] + 1)):
        return f"{views[0]}-{views[-1]}"
    return ", ".join(map(str, views))


def _local(frame: SceneFrame, cameras: Cameras) -> tuple[np.ndarray, np.ndarray]:
    """Centres and viewing directions in the scene's right, ahead, up axes."""
    cameras = cameras.to(device="cpu", dtype=torch.float64)
    return frame.local(cameras.centers).numpy(), (cameras.forward @ frame.axes.T).numpy()


def _some_points(frame: SceneFrame, points: torch.Tensor | None) -> np.ndarray:
    if points is None or len(points) == 0:
        return np.zeros((0, 3))
    stride = max(1, len(points) // _MAX_POINTS)
    return frame.local(points[::stride].to(device="cpu", dtype=torch.float64)).numpy()


def _directions(axes, center: np.ndarray, toward: np.ndarray, columns: tuple[int, int], color: str, length: float):  # type: ignore[no-untyped-def]  # noqa: E501
    end = center + length * toward
    a, b = columns
    axes.plot(np.stack([center[:, a], end[:, a]]), np.stack([center[:, b], end[:, b]]), color=color, lw=0.8, zorder=1)
