"""Windows of the two passes: the original's plans where ours mean to be the same, and what ours promise."""

from __future__ import annotations

import json
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cat3d_core.windows import MOST_GIVEN, anchor_count, anchor_views, lay_out


@pytest.fixture(scope="module")
def plans(shared_fixtures):
    cases = json.loads((shared_fixtures / "seva_plans.json").read_text())["cases"]
    return {case["name"]: case for case in cases}


def _sizes(name):
    return [int(n) for n in re.search(r"P(\d+) N(\d+)", name).groups()]


@pytest.mark.parametrize(
    "name",
    [
        "two-pass interp P1 N80",
        "two-pass interp P1 N110",
        "two-pass interp-gt P3 N80",
        "two-pass interp-gt P6 N200",
    ],
)
def test_anchors_are_the_originals(plans, name):
    captured, targets = _sizes(name)
    count = anchor_count(captured, targets, 21)
    assert count == plans[name]["anchors"]
    assert anchor_views([0] * targets, count) == plans[name]["anchor_targets"]


@pytest.mark.parametrize("name", ["two-pass interp P1 N80", "two-pass interp P1 N110", "two-pass interp-gt P3 N80"])
def test_first_pass_is_the_originals(plans, name):
    """One window of the captured views and all anchors."""
    captured, targets = _sizes(name)
    (window,) = lay_out([0] * targets, captured, 21).first
    (theirs,) = plans[name]["first"]
    assert len(theirs) == captured + len(window.targets)
    assert [entry[0] for entry in theirs] == ["!"] * captured + [">"] * len(window.targets)


@pytest.mark.parametrize("name", ["two-pass interp P9 N200", "two-pass interp P32 N300"])
def test_many_captured_views_differ_on_purpose(plans, name):
    """The original's second pass has no captured view there, so that more lies between two anchors."""
    captured, targets = _sizes(name)
    assert all(
        entry[0] == ">" or int(entry[1:]) >= captured for w in plans[name]["second"] for entry in w if "N" not in entry
    )
    assert anchor_count(captured, targets, 21) > plans[name]["anchors"]
    assert lay_out([0] * targets, captured, 21).given == MOST_GIVEN


@pytest.mark.parametrize("name", ["gt", "gt T8"])
def test_one_pass_is_the_originals_first_window(plans, name):
    case = plans[name]
    views, captured = case["T"], case["inputs"]
    layout = lay_out([0] * (views - captured), captured, views)
    assert not layout.second
    ours = [f"!{i:03d}" for i in range(captured)] + [f">{i:03d}" for i in layout.first[0].targets]
    assert ours == case["chunks"][0]


@given(
    st.lists(st.integers(1, 60), min_size=1, max_size=4),
    st.integers(1, 40),
    st.integers(4, 24),
)
def test_every_view_is_made_once_between_its_anchors(lengths, captured, views):
    path = [number for number, length in enumerate(lengths) for _ in range(length)]
    layout = lay_out(path, captured, views)
    windows = layout.first + layout.second
    assert sorted(view for window in windows for view in window.targets) == list(range(len(path)))
    anchors = [view for window in layout.first for view in window.targets]
    for window in layout.first:
        assert not window.anchors
        assert len(window.targets) + captured <= max(4 * views, views - layout.given + captured)
    for window in layout.second:
        assert layout.given + len(window.anchors) + len(window.targets) <= views
        assert set(window.anchors) <= set(anchors)
        assert window.targets
        for view in window.targets:
            before = max(a for a in anchors if a < view)
            after = min(a for a in anchors if a > view)
            assert {before, after} <= set(window.anchors)
            assert path[before] == path[view] == path[after]


def test_small_windows_keep_fewer_captured_views():
    layout = lay_out([0] * 50, 9, 10)
    assert layout.given == 7
    with pytest.raises(ValueError, match="3 are too few"):
        lay_out([0] * 50, 2, 3)
