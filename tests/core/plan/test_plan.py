"""Whole plans: counts, groups, anchors, conditions, sample sets, reasons, and that they move with the world."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings

from cat3d_core.normalization import Similarity
from cat3d_core.plan import WIDE, Plan, PlanConfig, make_plan
from cat3d_core.trajectories import RECIPES
from tests.core.plan.layouts import FAMILIES, arc, assert_moved, cameras, forward_facing, ring, single
from tests.core.strategies import random_similarity, seeds

F64 = torch.float64


def check(plan: Plan) -> None:
    """What holds for every plan."""
    n = len(plan)
    plan.cameras.validate()
    assert sorted(v for group in plan.groups for v in group.targets) == list(range(n))  # each view in exactly one group
    assert plan.group_views.tolist() == [
        [*group.targets, *[-1] * (plan.group_views.shape[1] - len(group.targets))] for group in plan.groups
    ]
    for group in plan.groups:
        kept = list(group.targets)
        assert (plan.condition[kept] == plan.condition[kept[0]]).all()
        assert plan.condition[kept[0]][plan.condition[kept[0]] >= 0].tolist() == list(group.conditions)
        assert plan.sample_kind[kept].unique().numel() == 1
        assert plan.anchor[kept].unique().numel() == 1
        if not plan.anchor[kept[0]]:
            assert plan.path[kept].unique().numel() == 1
    generated = plan.condition[plan.condition >= plan.captured_count] - plan.captured_count
    assert plan.anchor[generated].all()
    assert (plan.condition[:, 0] >= 0).all()
    for v in range(n):
        used = [c - plan.captured_count for c in plan.condition[v].tolist() if c >= plan.captured_count]
        assert all(plan.sample_kind[u] == plan.sample_kind[v] and not plan.anchor[v] for u in used)


def sizes(plan: Plan) -> list[int]:
    return [len(group.targets) for group in plan.groups]


@pytest.mark.parametrize("count", [60, pytest.param(None, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", sorted(FAMILIES))
def test_few_view_plans_of_each_family(name: str, count: int | None) -> None:
    """Of 60 views, and of as many as the paper's, which is up to 960."""
    captured = FAMILIES[name]()
    plan = make_plan(captured, PlanConfig(count=count, image_size=64))
    check(plan)
    assert plan.recipe == name
    assert len(plan) == (count or RECIPES[name].count)
    assert sizes(plan) == [5] * (len(plan) // 5)
    assert plan.condition.shape == (len(plan), 3)
    assert (plan.condition < len(captured)).all()
    assert not plan.anchor.any()
    assert plan.passes() == [list(range(len(plan.groups)))]
    assert plan.plan_coverage.directions > plan.captured_coverage.directions
    assert plan.plan_coverage.seen >= plan.captured_coverage.seen


@pytest.mark.parametrize("name", ["single_spiral", "single_orbit"])
def test_single_image_plan_is_the_papers(name: str) -> None:
    plan = make_plan(single(), PlanConfig(trajectory=name, image_size=64))
    check(plan)
    assert len(plan) == 80
    # Seven anchors in one pass of 1 + 7 on the captured view alone, then groups of 5 on 3: captured and two anchors.
    assert sizes(plan) == [7] + [5] * 14 + [3]
    assert plan.anchor.sum() == 7
    assert plan.passes() == [[0], list(range(1, 16))]
    assert plan.condition[plan.anchor].tolist() == [[0, -1, -1]] * 7
    rest = plan.condition[~plan.anchor]
    assert (rest[:, 0] == 0).all()
    assert (rest[:, 1:] >= 1).all()
    assert (rest[:, 1] != rest[:, 2]).all()


@settings(max_examples=5)
@given(seeds)
def test_plans_move_with_the_world(seed: int) -> None:
    g = random_similarity(seed)
    for name, make in FAMILIES.items():
        captured = make()
        config = PlanConfig(count=60, image_size=32, samples="both")
        plan, moved = make_plan(captured, config), make_plan(g.cameras(captured), config)
        assert plan.recipe == name
        assert_moved(plan, moved, g)
        assert torch.equal(plan.condition, moved.condition)


@settings(max_examples=10)
@given(seeds)
def test_plans_with_points_and_bounds_move_with_the_world(seed: int) -> None:
    g = random_similarity(seed)
    points = 0.15 * torch.randn(500, 3, generator=torch.Generator().manual_seed(2), dtype=F64)
    bounds = torch.tensor([[0.7, 2.0]], dtype=F64)
    config = PlanConfig(count=40, image_size=32)
    assert_moved(make_plan(ring(), config, points), make_plan(g.cameras(ring()), config, g.points(points)), g)
    # A single view has a scale only through its depth.
    assert_moved(
        make_plan(single(), config, depth_bounds=bounds),
        make_plan(g.cameras(single()), config, depth_bounds=g.scale * bounds),
        g,
    )


def test_a_plan_is_the_same_every_time_and_in_float32() -> None:
    captured = arc()
    a, b = (make_plan(captured, PlanConfig(count=40, image_size=32)) for _ in range(2))
    assert_moved(a, b, Similarity(1.0, torch.eye(3, dtype=F64), torch.zeros(3, dtype=F64)), tolerance=1e-15)
    c = make_plan(captured.to(dtype=torch.float32), PlanConfig(count=40, image_size=32))
    assert torch.allclose(a.cameras.centers, c.cameras.centers, atol=1e-4)


def test_groups_hold_neighbours() -> None:
    plan = make_plan(ring(), PlanConfig(image_size=32))
    centers = plan.cameras.centers
    within = torch.stack([torch.pdist(centers[row]).max() for row in plan.group_views])  # no short group in it
    random = torch.stack([torch.pdist(centers[torch.randperm(len(plan))[:5]]).max() for _ in range(100)])
    assert within.max() < 0.4
    assert within.mean() < 0.25 * random.mean()


def test_the_last_group_may_be_short_and_conditions_can_be_any_number() -> None:
    plan = make_plan(arc(), PlanConfig(count=23, image_size=32, conditions=1))
    check(plan)
    assert sizes(plan) == [7, 7, 7, 2]
    wide = make_plan(arc(2), PlanConfig(count=20, image_size=32, conditions=4, group_size=4))
    check(wide)
    assert set(wide.condition[0].tolist()) == {0, 1}
    none = make_plan(arc(2), PlanConfig(count=20, image_size=32, repeat_conditions=False))
    assert all(set(group.conditions) == {0, 1} and len(group.conditions) == 2 for group in none.groups)


def test_two_captured_views_condition_every_group_nearest_first() -> None:
    captured = arc(2)
    plan = make_plan(captured, PlanConfig(count=20, image_size=32))
    check(plan)
    assert plan.condition[0].tolist() == [0, 1, 0]
    assert plan.condition[-1].tolist() == [1, 0, 1]


def test_anchors_of_several_views_and_keeping_captured_ones() -> None:
    captured = ring(2)
    near = make_plan(captured, PlanConfig("mipnerf360", count=60, image_size=32, anchors=10))
    kept = make_plan(captured, PlanConfig("mipnerf360", count=60, image_size=32, anchors=10, keep_captured=True))
    check(near)
    check(kept)
    assert near.anchor.sum() == kept.anchor.sum() == 10
    assert set(near.condition[near.anchor].unique().tolist()) == {0, 1}  # anchors see captured views only
    rest = kept.condition[~kept.anchor]
    assert all({0, 1} < set(row) for row in rest.tolist())
    assert not all({0, 1} <= set(row) for row in near.condition[~near.anchor].tolist())
    assert [len(p) for p in near.passes()] == [2, len(near.groups) - 2]


def test_more_anchors_than_views_and_no_anchors() -> None:
    few = make_plan(single(), PlanConfig(count=4, image_size=32))
    check(few)
    assert few.anchor.all()
    assert sizes(few) == [4]
    none = make_plan(single(), PlanConfig(count=10, image_size=32, anchors=0))
    check(none)
    assert none.condition.tolist() == [[0, 0, 0]] * 10


def test_square_and_wide_samples_of_wide_images() -> None:
    captured = forward_facing()  # 96 x 64
    square = make_plan(captured, PlanConfig(count=40, image_size=32))
    both = make_plan(captured, PlanConfig(count=40, image_size=32, samples="both"))
    check(both)
    assert len(both) == 80
    assert torch.equal(both.cameras.world_from_camera[:40], both.cameras.world_from_camera[40:])
    wide = both.sample_kind == WIDE
    assert torch.equal(both.cameras.world_from_camera[~wide], both.cameras.world_from_camera[wide])
    assert torch.equal(both.cameras.intrinsics[~wide], square.cameras.intrinsics)
    # The wide sample sees 96 pixels where the square one sees 64.
    ratio = both.cameras.intrinsics[wide][:, 0, 0] / both.cameras.intrinsics[~wide][:, 0, 0]
    assert torch.allclose(ratio, torch.full((40,), 64 / 96, dtype=F64))
    assert both.window[wide].unique(dim=0).tolist() == [[0, 6, 32, 20]]
    assert both.window[~wide].unique(dim=0).tolist() == [[0, 0, 32, 32]]


def test_both_sample_sets_of_a_single_image_have_their_own_anchors() -> None:
    plan = make_plan(single(), PlanConfig(count=40, image_size=32, samples="both"))
    check(plan)
    assert plan.anchor.sum() == 14
    assert len(plan.passes()[0]) == 2


def test_views_that_add_nothing_can_be_dropped() -> None:
    config = PlanConfig("llff", count=200, image_size=32)
    full = make_plan(forward_facing(), config)
    less = make_plan(forward_facing(), PlanConfig("llff", count=200, image_size=32, drop_by_coverage=True))
    check(less)
    assert 0 < len(less) < 200
    assert less.plan_coverage == full.plan_coverage
    assert any(f"{200 - len(less)} of 200 views add nothing" in r for r in less.reasons)


def test_a_path_can_be_fitted_to_more_views_than_are_captured() -> None:
    everything = ring(12)
    captured = everything[[0, 1, 2]]
    alone = make_plan(captured, PlanConfig(count=60, image_size=32))
    fitted = make_plan(captured, PlanConfig(count=60, image_size=32), fit=everything)
    check(fitted)
    assert alone.recipe == "co3d"  # three views on an arc of 60 degrees
    assert fitted.recipe == "mipnerf360"
    whole = make_plan(everything, PlanConfig(count=60, image_size=32))
    # Not to the bit: the last one of a sum depends on where in memory its terms lie.
    torch.testing.assert_close(fitted.cameras.world_from_camera, whole.cameras.world_from_camera, rtol=0, atol=1e-12)
    assert fitted.captured_count == 3
    assert fitted.condition.max() == 2


@pytest.mark.parametrize("views", [2, 3, 8, 21])
def test_groups_are_as_large_as_the_generator_takes(views: int) -> None:
    """What is given and what is made come to `views`; of a single image the anchors are made on it alone."""
    plan = make_plan(arc(), PlanConfig(count=40, image_size=32, views=views))
    check(plan)
    given = min(3, views - 1)
    assert {len(group.conditions) for group in plan.groups} == {given}
    assert max(sizes(plan)) == views - given
    assert sum(size < views - given for size in sizes(plan)) <= len(plan.path.unique()), "the last of a path"
    alone = make_plan(single(), PlanConfig(count=40, image_size=32, views=views))
    check(alone)
    anchors = [group for group in alone.groups if group.anchors]
    assert [len(group.targets) for group in anchors] == (
        [7] if views >= 8 else [views - 1] * (7 // (views - 1)) + ([1] if 7 % (views - 1) else [])
    )


def test_a_plan_among_all_captured_views_names_the_same_views() -> None:
    """Planned from views 2, 5 and 9 of 12: conditions are those numbers, anchors come after all 12."""
    captured = ring(3)
    plan = make_plan(captured, PlanConfig(count=40, image_size=32, anchors=5))
    there = plan.among([2, 5, 9], 12)
    assert there.captured_count == 12
    for one, other in zip(plan.groups, there.groups, strict=True):
        for here, moved in zip(one.conditions, other.conditions, strict=True):
            assert moved == ([2, 5, 9][here] if here < 3 else here - 3 + 12)
    check(there)


def test_overrides() -> None:
    plan = make_plan(ring(), PlanConfig(scales=(1.0,), heights=(0.0, 0.1), image_size=32))
    assert len(plan) == 160
    asked = make_plan(ring(), PlanConfig(trajectory="co3d", count=20, image_size=32))
    assert asked.reasons == ["The trajectory co3d was asked for."]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"trajectory": "figure8"}, "no trajectory 'figure8'; use 'auto' or one of co3d, dtu"),
        ({"samples": "tall"}, "no sample set 'tall'"),
        ({"count": 0}, "count is 0; it must be at least 1"),
        ({"conditions": 0}, "conditions is 0"),
    ],
)
def test_faulty_configurations_are_refused_in_words(arguments: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        PlanConfig(**arguments)


def test_faulty_cameras_are_refused_in_words() -> None:
    with pytest.raises(ValueError, match="at least one captured view"):
        make_plan(single()[[]])
    broken = cameras(torch.tensor([[0.0, -1, 0], [0.1, -1, 0]], dtype=F64))
    broken.world_from_camera[1, 0, 3] = float("nan")
    with pytest.raises(ValueError, match="view number 1 has a NaN"):
        make_plan(broken)
