"""The plan in the store: what is read is what was written; older plans are read, and leave nothing behind."""

from __future__ import annotations

import tarfile
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from cat3d_core.plan import Plan, PlanConfig, make_plan
from flows.generation.plan import read_plan, write_plan
from flows.media.plan_drawing import draw_plan, plan_table
from schemas.scene_store import SceneStore, Section
from tests.core.plan.layouts import forward_facing, ring, single

FIXTURE = Path(__file__).parents[2] / "fixtures" / "sweep_of_0888913.tar.gz"


@pytest.fixture
def section(tmp_path: Path) -> Section:
    return SceneStore.create(tmp_path / "scene.zarr", "scene", "test", {}).run("run", create=True).plan


def assert_equal(one: Plan, other: Plan) -> None:
    for field in fields(Plan):
        a, b = getattr(one, field.name), getattr(other, field.name)
        if field.name in ("cameras", "frame"):
            for name in vars(a):
                assert torch.equal(torch.as_tensor(vars(a)[name]), torch.as_tensor(vars(b)[name])), name
        elif isinstance(a, torch.Tensor):
            assert torch.equal(a, b), field.name
        else:
            assert a == b, field.name


@pytest.mark.parametrize("name", ["single", "anchors", "both kinds", "covered"])
def test_a_plan_is_read_as_it_was_written(section: Section, name: str) -> None:
    plan = {
        "single": lambda: make_plan(single(), PlanConfig(image_size=64)),
        "anchors": lambda: make_plan(ring(3), PlanConfig(count=23, anchors=4, image_size=64)).among([1, 4, 6], 8),
        "both kinds": lambda: make_plan(forward_facing(), PlanConfig(count=21, samples="both", image_size=64)),
        "covered": lambda: replace(make_plan(ring(4), PlanConfig(count=20, image_size=64)), needed=False),
    }[name]()
    write_plan(section, plan)
    again = read_plan(section, plan.captured_count)
    assert_equal(again, plan)
    assert again.passes() == plan.passes()
    assert plan_table(again).row_count == plan_table(plan).row_count
    assert len(draw_plan(ring(4), again)) > 10_000


def test_a_plan_that_commit_0888913_stored_is_read_and_replaced_whole(tmp_path: Path) -> None:
    """It marked repeats that filled up short groups, kept no frame, and had arrays that nobody read."""
    with tarfile.open(FIXTURE) as archive:
        archive.extractall(tmp_path, filter="data")
    (path,) = (tmp_path / "out").glob("*.zarr")
    store = SceneStore.open(path, "r+")
    section, count = store.run("v3-cat3d").plan, store.captured.shape("size")[0]
    views, valid = section.read("group_views"), section.read("group_valid")
    plan = read_plan(section, count)
    assert plan.frame is None
    assert plan.captured_count == count
    assert [list(group.targets) for group in plan.groups] == [row[kept].tolist() for row, kept in zip(views, valid)]
    assert np.array_equal(plan.condition.numpy(), section.read("condition"))
    with pytest.raises(ValueError, match="plan the scene again"):
        draw_plan(ring(4), plan)
    new = make_plan(ring(3), PlanConfig(count=23, image_size=64)).among([0, 1, 2], count)
    write_plan(section, new)
    assert_equal(read_plan(section, count), new)
    assert not {"group", "order", "pose", "group_valid", "group_targets"} & set(section.names())
