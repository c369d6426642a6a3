"""Anchors, groups and conditioning views."""

from __future__ import annotations

from itertools import combinations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from cat3d_core.view_selection import (
    NO_VIEW,
    consecutive_groups,
    covering_radius,
    evenly,
    farthest_points,
    nearest_views,
    pose_distance,
)
from tests.core.plan.layouts import cameras, forward_facing, ring, single
from tests.core.strategies import random_similarity, seeds

F64 = torch.float64


def scattered(seed: int, count: int):  # type: ignore[no-untyped-def]
    return cameras(torch.randn(count, 3, generator=torch.Generator().manual_seed(seed), dtype=F64) + 4)


@given(seeds, st.integers(5, 9), st.integers(1, 4))
def test_farthest_points_are_within_twice_the_best_covering(seed: int, count: int, k: int) -> None:
    views = scattered(seed, count)
    greedy = covering_radius(views, farthest_points(views, k))
    best = min(covering_radius(views, list(c)) for c in combinations(range(count), k))
    assert greedy <= 2 * best + 1e-9


@given(seeds)
def test_farthest_points_follow_the_definition(seed: int) -> None:
    views, given_views = scattered(seed, 30), scattered(seed + 1, 2)
    taken = farthest_points(views, 6, given=given_views)
    assert len(set(taken)) == 6
    for i, pick in enumerate(taken):
        have = torch.cat([given_views.centers, views.centers[taken[:i]]])
        nearest = torch.cdist(views.centers, have).amin(1)
        assert nearest[pick] >= nearest.max() - 1e-8


@given(seeds)
def test_farthest_points_move_with_the_world(seed: int) -> None:
    views = ring(24)
    g = random_similarity(seed)
    assert farthest_points(views, 7, 1.0) == farthest_points(g.cameras(views), 7, g.scale)


def test_farthest_points_of_coincident_cameras_are_distinct() -> None:
    views = cameras(torch.tensor([[1.0, 0, 0]], dtype=F64).repeat(5, 1))
    assert sorted(farthest_points(views, 5)) == [0, 1, 2, 3, 4]
    with pytest.raises(ValueError, match="6 anchors were asked for, but the trajectory has 5 views"):
        farthest_points(views, 6)


@given(st.integers(0, 40), st.integers(1, 9))
def test_groups_partition_the_views_in_order(count: int, size: int) -> None:
    groups = consecutive_groups(list(range(count)), size)
    assert [v for g in groups for v in g] == list(range(count))
    assert all(len(g) == size for g in groups[:-1])


def test_nearest_views_by_brute_force() -> None:
    views, group = ring(12), ring(12)[[3, 4]]
    distance = pose_distance(group, views, 1.0).mean(0)
    assert nearest_views(group, views, 3, 1.0) == distance.argsort()[:3].tolist()


def test_pose_distance_tells_apart_views_at_one_spot() -> None:
    centers = torch.zeros(2, 3, dtype=F64)
    two = cameras(centers, torch.tensor([[1.0, 0, 0], [0, 1.0, 0]], dtype=F64))
    d = pose_distance(two, two, 1.0)
    assert torch.allclose(d, torch.tensor([[0, 2**0.5], [2**0.5, 0]], dtype=F64), atol=1e-12)


def test_more_conditions_than_captured_views() -> None:
    group, two = forward_facing()[[0, 1]], forward_facing()[[1, 8]]
    assert nearest_views(group, two, 5, 1.0) == [0, 1, 0, 1, 0]
    assert nearest_views(group, two, 5, 1.0, repeat=False) == [0, 1, NO_VIEW, NO_VIEW, NO_VIEW]
    assert nearest_views(group, single(), 3, 1.0) == [0, 0, 0]
    with pytest.raises(ValueError, match="no view to be conditioned on"):
        nearest_views(group, two[[]], 3, 1.0)


def test_views_taken_first_come_before_nearer_ones() -> None:
    views = ring(12)
    near = nearest_views(views[[6]], views, 3, 1.0)
    assert near[0] == 6
    kept = nearest_views(views[[6]], views, 3, 1.0, first=2)
    assert set(kept[:2]) == {0, 1}
    assert kept[2] == 6


@pytest.mark.parametrize(
    ("count", "most", "expected"), [(10, 4, [0, 3, 6, 9]), (3, 8, [0, 1, 2]), (7, 1, [0]), (0, 3, [])]
)
def test_evenly_goes_from_the_first_to_the_last(count: int, most: int, expected: list[int]) -> None:
    assert evenly(count, most) == expected
