"""Coverage: its definition against a plain loop, its bounds, and that it moves with the world."""

from __future__ import annotations

import torch
from hypothesis import given
from hypothesis import strategies as st

from cat3d_core.coverage import BINS, bin_of, coverage, direction_bins, gains, voxel_grid
from cat3d_core.trajectories import scene_frame
from tests.core.plan.layouts import FAMILIES, ring
from tests.core.strategies import random_similarity, seeds


def test_coverage_agrees_with_a_plain_loop() -> None:
    views = ring(5)
    frame = scene_frame(views)
    voxels = voxel_grid(frame, resolution=4)
    assert len(voxels) == 64
    pairs, seen = set(), set()
    for n in range(len(views)):
        for k, voxel in enumerate(voxels):
            pixel, depth = views[n].project(voxel[None])
            x, y = pixel[0, 0].tolist()
            if depth > 0 and 0 <= x <= views.size[n, 0] and 0 <= y <= views.size[n, 1]:
                toward = frame.axes @ (views.centers[n] - voxel)
                pairs.add((k, int(bin_of(toward))))
                seen.add(k)
    found = coverage(direction_bins(views, frame, voxels))
    assert found.seen == len(seen) / 64
    assert found.directions == len(pairs) / 64
    assert int(gains(direction_bins(views, frame, voxels)).sum()) == len(pairs)


@given(st.integers(0, 4), seeds)
def test_coverage_moves_with_the_world(which: int, seed: int) -> None:
    views = list(FAMILIES.values())[which]()
    moved = random_similarity(seed).cameras(views)
    here = scene_frame(views)
    there = scene_frame(moved)
    a = direction_bins(views, here, voxel_grid(here))
    b = direction_bins(moved, there, voxel_grid(there))
    assert (a != b).double().mean() < 1e-3  # voxels exactly on an image edge may fall either way


def test_more_views_never_cover_less_and_repeats_add_nothing() -> None:
    views = ring(8)
    frame = scene_frame(views)
    bins = direction_bins(views, frame, voxel_grid(frame))
    some, all_ = coverage(bins[:3]), coverage(bins)
    assert some.seen <= all_.seen
    assert some.directions < all_.directions
    assert gains(bins[:3], given=bins).tolist() == [0, 0, 0]
    assert gains(bins).gt(0).all()


def test_only_voxels_near_points_count_when_there_are_points() -> None:
    frame = scene_frame(ring(8))
    point = frame.center[None] + 0.01
    assert len(voxel_grid(frame, point)) == 27
    assert len(voxel_grid(frame, point + 1000)) == 12**3  # none inside: the whole cube


def test_bins_have_equal_solid_angles() -> None:
    directions = torch.randn(200_000, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    share = torch.bincount(bin_of(directions), minlength=BINS) / len(directions)
    assert share.shape == (BINS,)
    # Counts of about 1560 with a binomial deviation of 2.5%: five of them.
    assert (share * BINS - 1).abs().max() < 0.13


def test_voxels_are_the_middles_of_a_cube_of_the_scenes_frame() -> None:
    """Closed form: a cube of 1.5 times the scene's distance, about its centre, along its axes."""
    frame = scene_frame(ring(5))
    middles = [(i + 0.5) * 1.5 / 3 - 0.75 for i in range(3)]
    expected = torch.tensor([[x, y, z] for x in middles for y in middles for z in middles], dtype=torch.float64)
    torch.testing.assert_close(frame.local(voxel_grid(frame, resolution=3)), expected)
    point = frame.center + frame.distance * expected[5:6] @ frame.axes  # at x, y, z places 0, 1, 2
    near = voxel_grid(frame, point, resolution=3)
    beside = [i for i in range(27) if i // 9 < 2 and i % 3 > 0]
    torch.testing.assert_close(frame.local(near), expected[beside])
