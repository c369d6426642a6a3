"""Means over scenes with their error over seeds, from rows of the summary; the arithmetic is in cat3d_core."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import Any

from cat3d_core.metrics.seeds import Mean, difference, mean_over_seeds

#: What stands beside a number that differs from the best one by no more than seeds explain.
NOISE = "≈"

Rows = Sequence[dict[str, Any]]


def by_scene(rows: Rows, metric: str) -> dict[str, list[float]]:
    """Scene -> what was measured of it, one value a seed."""
    values: dict[str, list[float]] = defaultdict(list)
    for row in rows:
        if row[metric] is not None:
            values[row["scene_id"]].append(row[metric])
    return dict(values)


def mean_of(rows: Rows, metric: str) -> Mean | None:
    """The mean over scenes; None where nothing was measured."""
    values = by_scene(rows, metric)
    return mean_over_seeds(values) if values else None


def change(now: Rows, before: Rows, metric: str) -> Mean | None:
    """How much more `now` is than `before`, on the scenes that both have; None where they have none in common."""
    first, second = by_scene(now, metric), by_scene(before, metric)
    common = first.keys() & second.keys()
    if not common:
        return None
    return difference(*(mean_over_seeds({scene: v[scene] for scene in sorted(common)}) for v in (first, second)))


def seeds_of(rows: Rows) -> int:
    """The number of different seeds."""
    return len({row["seed"] for row in rows})
