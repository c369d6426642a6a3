"""The plan: which views are generated, from which cameras, in which groups, conditioned on what, and why.

Made once per scene from the captured cameras, stored and printed before anything is sampled.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from cat3d_core.cameras import Cameras
from cat3d_core.coverage import Coverage, coverage, direction_bins, gains, seen_from_nearby, voxel_grid
from cat3d_core.sample_sets import KINDS, kept_window, sample_cameras
from cat3d_core.trajectories import RECIPES, FreeSpace, SceneFrame, build_trajectory, choose_recipe, scene_frame
from cat3d_core.view_selection import NO_VIEW, consecutive_groups, farthest_points, nearest_views, pad_group

SQUARE, WIDE = range(2)
#: A captured view this close in direction shows a place as a generated one would.
COVERED_DEG = 15.0
_VIEWS_PER_PASS = 8  # conditioning + target views the model was trained for


@dataclass(frozen=True)
class PlanConfig:
    """What to plan. None means: as the paper does for this number of captured views.

    trajectory: 'auto' or a name in RECIPES. count: generated views per sample kind (the recipe's by default).
    scales, sides, heights, forwards: replace the recipe's (units of the scene's distance). anchors: 7 for one captured
    view, else 0. conditions: M, conditioning views per group (3). group_size: target views per group (8 - M); anchors
    of a single image are made in groups of 7 on that image alone. keep_captured: captured views take conditioning
    slots before anchors do. samples: 'square', 'wide' or 'both' ('both' generates every view twice). image_size: side
    of a sample in pixels. pitch_down_deg: how far a single captured camera looks down (several show it themselves).
    drop_by_coverage: leave out views that add nothing to the coverage. covered_share: plan that nothing be generated
    where captured views see this share of what the path's views see from nearly the same directions (at most
    COVERED_DEG beside them); None: generate in any case.
    """

    trajectory: str = "auto"
    count: int | None = None
    scales: tuple[float, ...] | None = None
    sides: tuple[float, ...] | None = None
    heights: tuple[float, ...] | None = None
    forwards: tuple[float, ...] | None = None
    anchors: int | None = None
    conditions: int | None = None
    group_size: int | None = None
    keep_captured: bool = False
    repeat_conditions: bool = True
    samples: str = "square"
    image_size: int = 512
    pitch_down_deg: float = 0.0
    drop_by_coverage: bool = False
    covered_share: float | None = None

    def __post_init__(self) -> None:
        if self.trajectory != "auto" and self.trajectory not in RECIPES:
            raise ValueError(
                f"There is no trajectory {self.trajectory!r}; use 'auto' or one of {', '.join(sorted(RECIPES))}."
            )
        if self.samples not in (*KINDS, "both"):
            raise ValueError(f"There is no sample set {self.samples!r}; use 'square', 'wide' or 'both'.")
        least = {"count": 1, "anchors": 0, "conditions": 1, "group_size": 1, "image_size": 1}
        for name, minimum in least.items():
            value = getattr(self, name)
            if value is not None and value < minimum:
                raise ValueError(f"The plan's {name} is {value}; it must be at least {minimum}.")


@dataclass(frozen=True)
class Plan:
    """N views to generate, in G groups of at most S targets.

    cameras: N sample cameras, square, float64. path (N,): index of the path. pose (N,): index of the trajectory pose
    (equal for the square and the wide sample of one pose). group (N,), order_in_group (N,). anchor (N,) bool.
    condition (N, M): what the view is conditioned on: -1 nothing, 0..V-1 a captured view, V + j generated view j (an
    anchor); all views of a group have the same row. group_views (G, S): views of each group in order, short groups
    filled by repeats; -1 beyond group_targets (G,), the number of targets the network gets. group_valid (G, S) bool:
    False for repeats, whose outputs are dropped. sample_kind (N,): 0 square, 1 wide. window (N, 4): [x0, y0, width,
    height] of the sample to keep. recipe: name. reasons: why, in sentences. frame: the scene as the plan saw it.
    captured_count: V. captured_coverage, plan_coverage: before and after (captured and planned views together).
    needed: False where captured views cover the path already (`PlanConfig.covered_share`): sample nothing.
    """

    cameras: Cameras
    path: Tensor
    pose: Tensor
    group: Tensor
    order_in_group: Tensor
    anchor: Tensor
    condition: Tensor
    group_views: Tensor
    group_valid: Tensor
    group_targets: Tensor
    sample_kind: Tensor
    window: Tensor
    recipe: str
    reasons: list[str]
    frame: SceneFrame
    captured_count: int
    captured_coverage: Coverage
    plan_coverage: Coverage
    needed: bool = True

    def __len__(self) -> int:
        return len(self.cameras)

    def passes(self) -> list[list[int]]:
        """Groups that can be sampled at the same time, in order: anchor groups first, then the rest."""
        is_anchor = [bool(self.anchor[v]) for v in self.group_views[:, 0].tolist()]
        first = [g for g, a in enumerate(is_anchor) if a]
        return [p for p in (first, [g for g, a in enumerate(is_anchor) if not a]) if p]


def make_plan(
    captured: Cameras,
    config: PlanConfig | None = None,
    points: Tensor | None = None,
    depth_bounds: Tensor | None = None,
    seed: int = 0,
    frame: SceneFrame | None = None,
    fit: Cameras | None = None,
) -> Plan:
    """Plan the generated views of a scene from its captured cameras (paper, 'Generating Novel Views' and its appendix).

    captured: V >= 1 cameras in any one world frame. points (P, 3), depth_bounds (V, 2): what is known of the geometry.
    frame: centre, up and distance, when they are known better than from the cameras. fit: cameras (poses only) that
    the recipe and its circles and ellipses are fitted to, the captured ones by default; the paper takes all views of
    the training set, also where only three of them are captured views. seed: only thins out more than
    10,000 points. The plan moves with the world: planning g(captured) gives g(plan) for every similarity g, provided
    the scale is known (two cameras apart, depth, or `frame`). Raises ValueError for no or faulty cameras.
    """
    config = config or PlanConfig()
    if len(captured) == 0:
        raise ValueError("A plan needs at least one captured view.")
    captured.validate()
    captured = captured.to(device="cpu", dtype=torch.float64)
    points = None if points is None else points.to(device="cpu", dtype=torch.float64)
    fit = captured if fit is None else fit.to(device="cpu", dtype=torch.float64)
    fit.validate()
    frame = frame or scene_frame(fit, points, depth_bounds, config.pitch_down_deg)
    if config.trajectory == "auto":
        name, reasons = choose_recipe(fit, frame, points)
    else:
        name, reasons = config.trajectory, [f"The trajectory {config.trajectory} was asked for."]
    recipe = RECIPES[name].with_shifts(config.scales, config.sides, config.heights, config.forwards)
    free = FreeSpace.of(fit, frame, points, seed)
    poses, path, changes = build_trajectory(recipe, frame, captured if recipe.from_inputs else fit, free, config.count)
    reasons = reasons + changes

    # Coverage is a property of the poses: measured once, on the first sample kind.
    kinds = [k for k in KINDS if config.samples in (k, "both")]
    voxels = voxel_grid(frame, points)
    before = direction_bins(sample_cameras(captured, kinds[-1], config.image_size), frame, voxels)
    after = direction_bins(_with_poses(captured, poses, kinds[-1], config.image_size), frame, voxels)
    needed = True
    if config.covered_share is not None:
        planned = _with_poses(captured, poses, kinds[-1], config.image_size)
        known = sample_cameras(captured, kinds[-1], config.image_size)
        share = float(seen_from_nearby(planned, known, voxels, COVERED_DEG).mean())
        needed = share < config.covered_share
        seen = f"captured views see {share:.0%} of what its views see from within {COVERED_DEG:g} degrees of them"
        if needed:
            reasons.append(f"The path is not covered by captured views: {seen} ({config.covered_share:.0%} would do).")
        else:
            reasons.append(f"The path is covered, so its {len(poses)} views need not be generated: {seen}.")
    if config.drop_by_coverage and needed:
        useful = gains(after, before) > 0
        if useful.any() and not useful.all():
            reasons.append(
                f"{int((~useful).sum())} of {len(useful)} views add nothing to the coverage and were dropped."
            )
            poses, path, after = poses[useful], path[useful], after[useful]

    parts = [_group(captured, poses, path, kind, config, frame) for kind in kinds]
    merged = _merge(parts, len(captured))
    return Plan(
        **merged,
        recipe=name,
        reasons=reasons,
        frame=frame,
        captured_count=len(captured),
        captured_coverage=coverage(before),
        plan_coverage=coverage(torch.cat([before, after])),
        needed=needed,
    )


def _with_poses(captured: Cameras, poses: Tensor, kind: str, image_size: int) -> Cameras:
    """Sample cameras at poses (N, 4, 4), with the median of the captured views' intrinsics."""
    samples = sample_cameras(captured, kind, image_size)
    intrinsics = samples.intrinsics.median(0).values
    return Cameras(intrinsics.expand(len(poses), 3, 3).clone(), poses, samples.size[:1].expand(len(poses), 2).clone())


def _group(captured: Cameras, poses: Tensor, path: Tensor, kind: str, config: PlanConfig, frame: SceneFrame) -> dict:
    """Anchors, groups and conditions of one sample kind."""
    cameras = _with_poses(captured, poses, kind, config.image_size)
    single = len(captured) == 1
    slots = config.conditions or 3
    size = config.group_size or max(1, _VIEWS_PER_PASS - slots)
    wanted = config.anchors if config.anchors is not None else (7 if single else 0)
    anchors = farthest_points(cameras, min(wanted, len(cameras)), frame.distance, given=captured)
    # A single image makes its anchors in one pass of 1 + 7; several images make theirs like any group.
    anchor_size = _VIEWS_PER_PASS - 1 if single and config.group_size is None else size
    others = sorted(set(range(len(cameras))) - set(anchors))
    runs = [others[i:j] for i, j in _runs(path[others].tolist())]
    groups = [(g, anchor_size, True) for g in consecutive_groups(anchors, anchor_size)]
    groups += [(g, size, False) for run in runs for g in consecutive_groups(run, size)]

    width = max(n for _, n, _ in groups)
    views = torch.full((len(groups), width), NO_VIEW, dtype=torch.long)
    valid = torch.zeros(len(groups), width, dtype=torch.bool)
    group, order = torch.zeros(2, len(cameras), dtype=torch.long)
    condition = torch.full((len(cameras), slots), NO_VIEW, dtype=torch.long)
    sources = Cameras.cat([captured, cameras[anchors]])
    names = list(range(len(captured))) + [len(captured) + a for a in anchors]
    # One captured view is always kept (paper: 'given the observed and anchor views').
    first = len(captured) if config.keep_captured or single else 0
    for number, (members, targets, of_anchors) in enumerate(groups):
        padded, kept = pad_group(members, targets)
        views[number, :targets], valid[number, :targets] = torch.tensor(padded), torch.tensor(kept)
        group[members], order[members] = number, torch.arange(len(members))
        near = cameras[members]
        if of_anchors and single:
            row = [0]
        elif of_anchors:
            row = nearest_views(near, captured, slots, frame.distance, repeat=config.repeat_conditions)
        else:
            row = nearest_views(near, sources, slots, frame.distance, first, config.repeat_conditions)
            row = [names[i] if i != NO_VIEW else NO_VIEW for i in row]
        condition[members, : len(row)] = torch.tensor(row)
    is_anchor = torch.zeros(len(cameras), dtype=torch.bool)
    is_anchor[anchors] = True
    median_size = captured.size.median(0).values[None]
    return {
        "cameras": cameras,
        "path": path,
        "pose": torch.arange(len(cameras)),
        "group": group,
        "order_in_group": order,
        "anchor": is_anchor,
        "condition": condition,
        "group_views": views,
        "group_valid": valid,
        "group_targets": torch.tensor([n for _, n, _ in groups]),
        "sample_kind": torch.full((len(cameras),), KINDS.index(kind)),
        "window": kept_window(median_size, kind, config.image_size).expand(len(cameras), 4).clone(),
    }


def _runs(path: list[int]) -> list[tuple[int, int]]:
    """Half-open ranges of equal path numbers: a group never spans two paths."""
    edges = [0] + [i for i in range(1, len(path)) if path[i] != path[i - 1]] + [len(path)]
    return [(a, b) for a, b in zip(edges, edges[1:], strict=False) if b > a]


def _merge(parts: list[dict], captured_count: int) -> dict:
    """The sample kinds' parts one after another, with view and group numbers moved on."""
    if len(parts) == 1:
        return parts[0]
    first, second = parts
    n, g = len(first["cameras"]), len(first["group_views"])
    second = dict(second)
    second["group"] = second["group"] + g
    second["group_views"] = torch.where(second["group_views"] >= 0, second["group_views"] + n, NO_VIEW)
    second["condition"] = torch.where(
        second["condition"] >= captured_count, second["condition"] + n, second["condition"]
    )
    return {
        k: Cameras.cat([first[k], second[k]]) if k == "cameras" else torch.cat([first[k], second[k]]) for k in first
    }
