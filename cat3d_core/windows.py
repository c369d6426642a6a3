"""Which views share a window: first anchors along the path, then what lies between them, captured views in each.

As SEVA's own two passes ("gt" first, then "interp-gt"), with these differences: an anchor is a view of the plan and
isn't made a second time; anchors never span two paths; the first pass is one window that grows with the anchors; and
with many captured views the second pass keeps the nearest instead of none.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from cat3d_core.view_selection import consecutive_groups

#: Captured views in a window of the second pass; of more, those nearest to its views.
MOST_GIVEN = 8
#: A first pass is one window up to so many times the trained number of views; then there are several.
LONGEST_FIRST_PASS = 4


class Window(NamedTuple):
    """Targets made together and the anchors given to them, both indices of the plan's views in the path's order."""

    anchors: list[int]
    targets: list[int]


class Layout(NamedTuple):
    """The windows of both passes; `second` is empty where one pass makes all. given: captured views in a window of the
    second pass."""

    first: list[Window]
    second: list[Window]
    given: int


def lay_out(path: Sequence[int], captured: int, views: int) -> Layout:
    """Windows of at most `views` views for targets whose path numbers are `path`, with so many captured views.

    Raises ValueError where `views` are too few for a captured view, two anchors and a view between them.
    """
    if views < 4:
        raise ValueError(f"Windows hold a captured view, two anchors and what lies between them; {views} are too few.")
    given = _given(captured, views)
    room = views - given
    if len(path) <= views - captured:
        return Layout([Window([], list(range(len(path))))], [], given)
    anchors = anchor_views(path, anchor_count(captured, len(path), views))
    longest = max(LONGEST_FIRST_PASS * views - captured, room)
    first = [Window([], part) for part in consecutive_groups(anchors, longest)]
    return Layout(first, _between(path, anchors, room), given)


def _given(captured: int, views: int) -> int:
    """Captured views in a window of the second pass, which leave room for two anchors and a view between them."""
    return min(captured, MOST_GIVEN, views - 3)


def anchor_count(captured: int, targets: int, views: int) -> int:
    """So many anchors that what lies between two of them fits into a window, and at least as many as fit into one."""
    between = views - 2 - _given(captured, views)
    return min(targets, max(-(-targets // between) + 1, views - captured))


def anchor_views(path: Sequence[int], count: int) -> list[int]:
    """About `count` views, evenly spaced along each path from its first to its last view (one alone for a path of one
    view), in order."""
    out = []
    for start, end in runs(path):
        length = end - start
        share = min(length, max(2, round(count * length / len(path))))
        # Half-way places go to the even view, as floating-point rounding has it.
        places = [round(i * (length - 1) / (share - 1)) for i in range(share)] if share > 1 else [0]
        out += [start + place for place in places]
    return out


def _between(path: Sequence[int], anchors: list[int], room: int) -> list[Window]:
    """Stretches between neighbouring anchors of one path, packed in order: a window takes the anchors round each of its
    stretches, and the last stretch that fits ends it."""
    out: list[Window] = []
    for left, right in zip(anchors, anchors[1:]):
        if path[left] != path[right] or right - left < 2:
            continue
        inside = list(range(left + 1, right))
        for piece in consecutive_groups(inside, room - 2):
            last = out[-1] if out else Window([], [])
            joined = [a for a in (left, right) if a not in last.anchors]
            if left in last.anchors and len(last.anchors + last.targets + joined + piece) <= room:
                out[-1] = Window(last.anchors + joined, last.targets + piece)
            else:
                out.append(Window([left, right], piece))
    return out


def runs(path: Sequence[int]) -> list[tuple[int, int]]:
    """Half-open ranges of equal path numbers: what is made together never spans two paths."""
    edges = [0] + [i for i in range(1, len(path)) if path[i] != path[i - 1]] + [len(path)]
    return [(a, b) for a, b in zip(edges, edges[1:]) if b > a]
