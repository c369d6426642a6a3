"""Benchmark of the plan: how well anchors cover a trajectory, and how long choosing and planning take.

`python -m flows.bench.plan` prints the rows; `rows()` gives them as dictionaries.
"""

from __future__ import annotations

import math
import statistics
import time

import torch

from cat3d_core.cameras import Cameras
from cat3d_core.plan import PlanConfig, make_plan
from cat3d_core.random import generator
from cat3d_core.trajectories import look_at
from cat3d_core.view_selection import covering_radius, farthest_points

_ANCHORS = 7
_TRIALS = 200


def _cameras(centers: torch.Tensor) -> Cameras:
    up, right = torch.tensor([0, 0, 1.0]).double(), torch.tensor([1.0, 0, 0]).double()
    n = len(centers)
    k = torch.tensor([[80.0, 0, 48], [0, 80, 32], [0, 0, 1]], dtype=torch.float64).expand(n, 3, 3)
    return Cameras(k, look_at(centers.double(), torch.zeros(3).double(), up, right), torch.tensor([[96, 64]] * n))


def _arc(count: int, degrees: float) -> Cameras:
    angle = torch.linspace(0, math.radians(degrees), count)
    return _cameras(torch.stack([angle.cos(), angle.sin(), torch.full_like(angle, 0.4)], -1))


def layouts() -> dict[str, Cameras]:
    """Five sets of views to choose anchors from: the two single-image paths, two few-view plans, and a ball."""
    one = _arc(1, 0)
    ball = torch.randn(800, 3, generator=generator(0, "bench", "ball"))
    ball = ball / ball.norm(dim=-1, keepdim=True) * torch.rand(800, 1, generator=generator(0, "bench", "r")) ** (1 / 3)
    return {
        "spiral (80)": make_plan(one, PlanConfig("single_spiral", image_size=64)).cameras,
        "orbit (80)": make_plan(one, PlanConfig("single_orbit", image_size=64)).cameras,
        "nine ellipses (720)": make_plan(_arc(9, 320), PlanConfig("mipnerf360", image_size=64)).cameras,
        "forward-facing circles (960)": make_plan(_arc(5, 20), PlanConfig("llff", image_size=64)).cameras,
        "random in a ball (800)": _cameras(ball),
    }


def coverage_rows() -> list[dict[str, object]]:
    """Largest distance from a view to its nearest anchor: farthest points against 200 random choices of 7."""
    out: list[dict[str, object]] = []
    for name, views in layouts().items():
        greedy = covering_radius(views, farthest_points(views, _ANCHORS))
        random = []
        for trial in range(_TRIALS):
            pick = torch.randperm(len(views), generator=generator(0, "bench", name, trial))[:_ANCHORS].tolist()
            random.append(covering_radius(views, pick))
        out.append(
            {
                "benchmark": "anchor covering radius",
                "case": name,
                "farthest_points": round(greedy, 4),
                "random_mean": round(statistics.mean(random), 4),
                "random_best": round(min(random), 4),
                "random_worse_share": sum(r > greedy for r in random) / len(random),
            }
        )
    return out


def timing_rows(repeats: int = 5) -> list[dict[str, object]]:
    """Median seconds for anchors among 10,000 cameras and for whole plans at the paper's counts."""
    many = _cameras(torch.randn(10_000, 3, generator=generator(0, "bench", "many")))
    points = 0.2 * torch.randn(20_000, 3, generator=generator(0, "bench", "points"))
    few = _arc(9, 320)
    cases = {
        "7 anchors of 10,000 cameras": lambda: farthest_points(many, 7),
        "100 anchors of 10,000 cameras": lambda: farthest_points(many, 100),
        "plan, 720 views": lambda: make_plan(few, PlanConfig("mipnerf360")),
        "plan, 720 views, 20,000 points": lambda: make_plan(few, PlanConfig("mipnerf360"), points),
        "plan, 960 views": lambda: make_plan(few, PlanConfig("llff")),
    }
    out: list[dict[str, object]] = []
    for name, work in cases.items():
        work()
        seconds = []
        for _ in range(repeats):
            begin = time.perf_counter()
            work()
            seconds.append(time.perf_counter() - begin)
        out.append({"benchmark": "plan time", "case": name, "time_s": round(statistics.median(seconds), 4)})
    return out


def rows() -> list[dict[str, object]]:
    """All rows of this benchmark."""
    return coverage_rows() + timing_rows()


if __name__ == "__main__":
    for row in rows():
        print("  ".join(f"{key}={value}" for key, value in row.items()))
