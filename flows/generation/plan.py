"""The plan of a run in its store: written once, read by everyone who samples, draws or shows it."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np
import torch

from cat3d_core.coverage import Coverage
from cat3d_core.plan import Group, Plan
from cat3d_core.sample_sets import KINDS
from cat3d_core.trajectories import SceneFrame
from cat3d_core.view_selection import NO_VIEW
from flows.jobs.access import read_cameras, write_cameras
from schemas.scene_store import Section


def write_plan(section: Section, plan: Plan) -> None:
    """Write a plan whose captured views are those of the store (`Plan.among`)."""
    arrays = {
        "condition": plan.condition,
        "anchor": plan.anchor,
        "path": plan.path,
        "sample_kind": plan.sample_kind.numpy().astype(np.uint8),
        "window": plan.window,
        "group_views": plan.group_views,
    }
    for name in set(section.names()) - set(arrays):  # of a plan that an older program stored, or the cameras
        section.remove(name)
    write_cameras(section, plan.cameras)
    for name, values in arrays.items():
        values = np.asarray(values)
        section.write(name, values.astype(np.int32) if values.dtype == np.int64 else values)
    section.set_attrs(
        recipe=plan.recipe,
        reasons=plan.reasons,
        needed=plan.needed,
        dropped=plan.dropped,
        image_size=int(plan.cameras.size[0, 0]),
        kinds=[kind for kind in KINDS if any(group.kind == kind for group in plan.groups)],
        captured_count=plan.captured_count,
        captured_coverage=asdict(plan.captured_coverage),
        plan_coverage=asdict(plan.plan_coverage),
        frame=None if plan.frame is None else {n: _plain(v) for n, v in vars(plan.frame).items()},
    )


def read_plan(section: Section, captured_count: int) -> Plan:
    """The stored plan; captured_count: of the store's captured views, which older plans don't say themselves.

    Plans of before 2026-11-29 marked repeats that filled short groups in an array of its own, and kept no frame."""
    attributes = section.attrs
    views, condition = section.read("group_views"), section.read("condition")
    anchor, kind = section.read("anchor"), section.read("sample_kind")
    if "group_valid" in section:
        views = np.where(section.read("group_valid"), views, NO_VIEW)
    groups = []
    for row in views:
        targets = row[row != NO_VIEW].tolist()
        given = condition[targets[0]]
        conditions = tuple(given[given != NO_VIEW].tolist())
        groups.append(Group(tuple(targets), conditions, KINDS[int(kind[targets[0]])], bool(anchor[targets[0]])))
    return Plan(
        cameras=read_cameras(section),
        path=_tensor(section.read("path")),
        window=_tensor(section.read("window")),
        groups=tuple(groups),
        recipe=attributes["recipe"],
        reasons=attributes["reasons"],
        frame=_frame(attributes.get("frame")),
        captured_count=attributes.get("captured_count", captured_count),
        captured_coverage=Coverage(**attributes["captured_coverage"]),
        plan_coverage=Coverage(**attributes["plan_coverage"]),
        needed=attributes["needed"],
        dropped=attributes.get("dropped", 0),
    )


def _tensor(values: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(values.astype(np.int64))


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, torch.Tensor) else value


def _frame(document: dict[str, Any] | None) -> SceneFrame | None:
    if document is None:
        return None
    vectors = {n: torch.tensor(v, dtype=torch.float64) for n, v in document.items() if isinstance(v, list)}
    return SceneFrame(**(document | vectors))
