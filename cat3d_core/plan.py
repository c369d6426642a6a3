"""The plan: which views are generated, from which cameras, in which groups, conditioned on what, and why.

Made once per scene from the captured cameras, stored and printed before anything is sampled.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from cat3d_core.cameras import Cameras
from cat3d_core.coverage import Coverage, coverage, direction_bins, gains, seen_from_nearby, voxel_grid
from cat3d_core.sample_sets import KINDS, kept_window, sample_cameras
from cat3d_core.trajectories import RECIPES, FreeSpace, SceneFrame, build_trajectory, choose_recipe, scene_frame
from cat3d_core.view_selection import NO_VIEW, consecutive_groups, farthest_points, nearest_views
from cat3d_core.windows import lay_out, runs

SQUARE, WIDE = range(2)
#: A captured view this close in direction shows a place as a generated one would.
COVERED_DEG = 15.0


@dataclass(frozen=True)
class PlanConfig:
    """What to plan. None means: as the paper does for this number of captured views.

    trajectory: 'auto' or a name in RECIPES. count: generated views per sample kind (the recipe's by default).
    views: conditioning and target views that the generator takes at once (paper: 8). scales, sides, heights, forwards:
    replace the recipe's (units of the scene's distance). anchors: 7 for one captured view, else 0. conditions: M,
    conditioning views per group (3). group_size: target views per group (views - M); anchors of a single image are
    made in groups of views - 1 on that image alone. keep_captured: captured views take conditioning
    slots before anchors do. samples: 'square', 'wide' or 'both' ('both' generates every view twice). image_size: side
    of a sample in pixels. pitch_down_deg: how far a single captured camera looks down (several show it themselves).
    drop_by_coverage: leave out views that add nothing to the coverage. covered_share: plan that nothing be generated
    where captured views see this share of what the path's views see from nearly the same directions (at most
    COVERED_DEG beside them); None: generate in any case. layout: "groups", as above, or "windows" (`windows.lay_out`),
    which needs neither anchors, conditions nor group_size.
    """

    trajectory: str = "auto"
    views: int = 8
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
    layout: Literal["groups", "windows"] = "groups"

    def __post_init__(self) -> None:
        if self.trajectory != "auto" and self.trajectory not in RECIPES:
            raise ValueError(
                f"There is no trajectory {self.trajectory!r}; use 'auto' or one of {', '.join(sorted(RECIPES))}."
            )
        if self.samples not in (*KINDS, "both"):
            raise ValueError(f"There is no sample set {self.samples!r}; use 'square', 'wide' or 'both'.")
        least = {"views": 2, "count": 1, "anchors": 0, "conditions": 1, "group_size": 1, "image_size": 1}
        for name, minimum in least.items():
            value = getattr(self, name)
            if value is not None and value < minimum:
                raise ValueError(f"The plan's {name} is {value}; it must be at least {minimum}.")


@dataclass(frozen=True)
class Group:
    """Views sampled together: targets (n), planned views in order, given conditions (m), below V a captured view, V + j
    the planned view j (an anchor). kind: the sample set, "square" or "wide". anchors: whether the targets are anchors.
    """

    targets: tuple[int, ...]
    conditions: tuple[int, ...]
    kind: str
    anchors: bool = False


@dataclass(frozen=True)
class Plan:
    """N views to generate, in groups.

    cameras: N sample cameras, square, float64. path (N,): index of the path. window (N, 4): [x0, y0, width, height] of
    the sample to keep. groups: each view is a target of one. recipe: name. reasons: why, in sentences. frame: the scene
    as the plan saw it (None where an older program stored the plan). captured_count: V. captured_coverage,
    plan_coverage: before and after (captured and planned views together). needed: False where captured views cover the
    path already (`PlanConfig.covered_share`): sample nothing. dropped: views of the path that add nothing to the
    coverage and are not among the N."""

    cameras: Cameras
    path: Tensor
    window: Tensor
    groups: tuple[Group, ...]
    recipe: str
    reasons: list[str]
    frame: SceneFrame | None
    captured_count: int
    captured_coverage: Coverage
    plan_coverage: Coverage
    needed: bool = True
    dropped: int = 0

    def __len__(self) -> int:
        return len(self.cameras)

    def passes(self) -> list[list[int]]:
        """Numbers of the groups that can be sampled at the same time: those of anchors, then the others, if needed."""
        numbers = range(len(self.groups)) if self.needed else ()
        parts = ([g for g in numbers if self.groups[g].anchors == first] for first in (True, False))
        return list(filter(None, parts))

    def among(self, views: Sequence[int], count: int) -> Plan:
        """The same plan where its captured view i is number views[i] of `count` captured views."""

        def number(view: int) -> int:
            return views[view] if view < self.captured_count else view + count - self.captured_count

        groups = (replace(group, conditions=tuple(map(number, group.conditions))) for group in self.groups)
        return replace(self, groups=tuple(groups), captured_count=count)

    @property
    def group_views(self) -> Tensor:
        """(G, S) targets of each group, NO_VIEW beyond them."""
        return _rows([group.targets for group in self.groups])

    @property
    def condition(self) -> Tensor:
        """(N, M) conditions of each view's group, NO_VIEW beyond them."""
        return _rows([group.conditions for group in self._by_view()])

    @property
    def anchor(self) -> Tensor:
        """(N,) bool."""
        return torch.tensor([group.anchors for group in self._by_view()])

    @property
    def sample_kind(self) -> Tensor:
        """(N,) number of each view's sample set: SQUARE or WIDE."""
        return torch.tensor([KINDS.index(group.kind) for group in self._by_view()])

    def _by_view(self) -> list[Group]:
        groups = {view: group for group in self.groups for view in group.targets}
        return [groups[view] for view in range(len(self))]


def _rows(rows: Sequence[Sequence[int]]) -> Tensor:
    """(R, longest) int64, NO_VIEW where a row is shorter."""
    out = torch.full((len(rows), max(map(len, rows))), NO_VIEW, dtype=torch.long)
    for row, values in zip(out, rows, strict=True):
        row[: len(values)] = torch.tensor(values)
    return out


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
    dropped = 0
    if config.drop_by_coverage and needed:
        useful = gains(after, before) > 0
        if useful.any() and not useful.all():
            dropped = int((~useful).sum())
            reasons.append(f"{dropped} of {len(useful)} views add nothing to the coverage and were dropped.")
            poses, path, after = poses[useful], path[useful], after[useful]

    samples = [_with_poses(captured, poses, kind, config.image_size) for kind in kinds]
    groups: list[Group] = []
    for number, (kind, cameras) in enumerate(zip(kinds, samples, strict=True)):
        grouped = _groups if config.layout == "groups" else _windows
        groups += grouped(captured, cameras, path, kind, config, frame, first=number * len(poses))
    size = captured.size.median(0).values[None]
    windows = [kept_window(size, kind, config.image_size).expand(len(poses), 4) for kind in kinds]
    return Plan(
        cameras=Cameras.cat(samples),
        path=path.repeat(len(kinds)),
        window=torch.cat(windows),
        groups=tuple(groups),
        recipe=name,
        reasons=reasons,
        frame=frame,
        captured_count=len(captured),
        captured_coverage=coverage(before),
        plan_coverage=coverage(torch.cat([before, after])),
        needed=needed,
        dropped=dropped,
    )


def _with_poses(captured: Cameras, poses: Tensor, kind: str, image_size: int) -> Cameras:
    """Sample cameras at poses (N, 4, 4), with the median of the captured views' intrinsics."""
    samples = sample_cameras(captured, kind, image_size)
    intrinsics = samples.intrinsics.median(0).values
    return Cameras(intrinsics.expand(len(poses), 3, 3).clone(), poses, samples.size[:1].expand(len(poses), 2).clone())


def _groups(
    captured: Cameras, cameras: Cameras, path: Tensor, kind: str, config: PlanConfig, frame: SceneFrame, first: int
) -> list[Group]:
    """Anchors, groups and conditions of one sample kind, whose views are numbered from `first` on."""
    single = len(captured) == 1
    slots = config.conditions or min(3, config.views - 1)
    size = config.group_size or max(1, config.views - slots)
    wanted = config.anchors if config.anchors is not None else (7 if single else 0)
    anchors = farthest_points(cameras, min(wanted, len(cameras)), frame.distance, given=captured)
    # A single image makes its anchors in one pass of 1 + 7; several images make theirs like any group.
    anchor_size = config.views - 1 if single and config.group_size is None else size
    others = sorted(set(range(len(cameras))) - set(anchors))
    members = [(g, True) for g in consecutive_groups(anchors, anchor_size)]
    for begin, end in runs(path[others].tolist()):
        members += [(g, False) for g in consecutive_groups(others[begin:end], size)]

    sources = Cameras.cat([captured, cameras[anchors]])
    names = [*range(len(captured)), *(len(captured) + first + anchor for anchor in anchors)]
    # One captured view is always kept (paper: 'given the observed and anchor views').
    kept = len(captured) if config.keep_captured or single else 0
    groups = []
    for views, of_anchors in members:
        near = cameras[views]
        if of_anchors and single:
            row = [0]
        elif of_anchors:
            row = nearest_views(near, captured, slots, frame.distance, repeat=config.repeat_conditions)
        else:
            row = nearest_views(near, sources, slots, frame.distance, kept, config.repeat_conditions)
        conditions = tuple(names[i] for i in row if i != NO_VIEW)
        groups.append(Group(tuple(first + v for v in views), conditions, kind, of_anchors))
    return groups


def _windows(
    captured: Cameras, cameras: Cameras, path: Tensor, kind: str, config: PlanConfig, frame: SceneFrame, first: int
) -> list[Group]:
    """The same in windows of both passes, the nearest captured views in each."""
    layout = lay_out(path.tolist(), len(captured), config.views)
    passes = ((layout.first, len(captured), bool(layout.second)), (layout.second, layout.given, False))
    groups, count = [], len(captured) + first
    for windows, slots, of_anchors in passes:
        for anchors, targets in windows:
            known = sorted(nearest_views(cameras[targets], captured, slots, frame.distance))
            conditions = (*known, *(count + anchor for anchor in anchors))
            groups.append(Group(tuple(first + view for view in targets), conditions, kind, of_anchors))
    return groups
