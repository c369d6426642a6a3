"""Fronts: which settings nothing beats in both cost and value, and where the defaults stand."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from flows.bench.registry import Panel
from flows.bench.rows import Row
from flows.bench.sampler import front as lowest_front


@dataclass(frozen=True)
class Drawn:
    """A panel with its rows: all with a finite cost and value, the front among them cheapest first, the defaults."""

    panel: Panel
    title: str
    rows: list[Row]
    front: list[Row]
    defaults: list[Row]

    def has_on_front(self, row: Row) -> bool:
        """Whether nothing beats the row (an equal one may stand for it in `front`)."""
        columns = (self.panel.cost, self.panel.value)
        return any(all(row[c] == other[c] for c in columns) for other in self.front)


def pareto_front(rows: list[Row], cost: str, value: str, higher_is_better: bool = False) -> list[Row]:
    """The rows that no other row equals or beats in both columns (of equal ones the first), cheapest first."""
    sign = -1 if higher_is_better else 1
    points = [{"cost": row[cost], "error": sign * row[value], "row": row} for row in rows]
    return [point["row"] for point in lowest_front(points, "cost")]


def drawn_panels(panel: Panel, rows: list[Row]) -> list[Drawn]:
    """One for each combination of values in `panel.each` with at least two rows."""
    groups: dict[tuple, list[Row]] = {}
    for row in rows:
        numbers = (row.get(panel.cost), row.get(panel.value))
        if all(row.get(k) == v for k, v in panel.where) and all(n is not None and math.isfinite(n) for n in numbers):
            groups.setdefault(tuple(row.get(name) for name in panel.each), []).append(row)
    out = []
    for values, members in groups.items():
        if len(members) > 1:
            title = ": ".join([panel.title, *([", ".join(map(str, values))] if values else [])])
            front = pareto_front(members, panel.cost, panel.value, panel.higher_is_better)
            out.append(Drawn(panel, title, members, front, [r for r in members if r.get("default")]))
    return out


def name_of(panel: Panel, row: Row) -> str:
    """A point's name: its values in the columns of series and label."""
    values = [row.get(name) for name in (*panel.series, *panel.label)]
    return " ".join(str(value) for value in values if value not in (None, ""))


def cell(value: Any) -> str:
    """A value as a table shows it."""
    if isinstance(value, bool):
        return "yes" if value else ""
    if isinstance(value, float):
        return f"{value:.0f}" if 1e3 <= abs(value) < 1e7 else f"{value:.4g}"
    return "" if value is None else str(value)


def verdict(drawn: Drawn) -> list[str]:
    """A sentence for each default: that it lies on the front, or what beats it in both and by how much."""
    panel, out = drawn.panel, []
    for row in drawn.defaults:
        name = f"default {name_of(panel, row)}"
        place = f"({panel.cost} {cell(row[panel.cost])}, {panel.value} {cell(row[panel.value])})"
        if drawn.has_on_front(row):
            out.append(f"{name}: on the front {place}.")
        else:
            # Along the front the value improves with the cost: the last that costs no more is the best of those.
            best = [r for r in drawn.front if r[panel.cost] <= row[panel.cost]][-1]
            rival = f"{name_of(panel, best)} ({cell(best[panel.cost])}, {cell(best[panel.value])})"
            out.append(f"{name}: not on the front {place}; beaten by {rival}.")
    return out
