"""Few-view splits by the published rule of each data family, where a scene brings no split file of its own."""

from __future__ import annotations

from collections.abc import Sequence

Splits = dict[str, dict[str, list[int]]]

# PixelNeRF's order of training views and its excluded views (over- or underexposed), for DTU's 49 views.
DTU_TRAIN_ORDER = (25, 22, 28, 40, 44, 48, 0, 8, 13)
DTU_EXCLUDED = (3, 4, 5, 6, 7, 16, 17, 18, 19, 20, 21, 36, 37, 38, 39)
EVERY_8TH = (
    "Split rule: every 8th image (from the first, in sorted order) is a test view; training views are a rounded "
)
EVERY_8TH += "linspace over the rest (RegNeRF's rule)."


def linspace_ids(ids: Sequence[int], count: int) -> list[int]:
    """`count` of the ids, evenly spread, both ends included: round half to even of a linspace (RegNeRF's rule)."""
    step = (len(ids) - 1) / (count - 1) if count > 1 else 0.0
    return [ids[round(i * step)] for i in range(count)]


def held_out(count: int, test: Sequence[int], view_counts: Sequence[int]) -> Splits:
    """Splits with these test views, and a linspace over the other views for each count up to theirs."""
    return of_lists([i for i in range(count) if i not in set(test)], test, view_counts)


def of_lists(train: Sequence[int], test: Sequence[int], view_counts: Sequence[int]) -> Splits:
    """Splits with these test views and, for each count, a linspace over these training views."""
    few = {str(k): {"train": linspace_ids(train, k), "test": list(test)} for k in view_counts if k <= len(train)}
    return few | {"all": {"train": list(train), "test": list(test)}}


def every_8th(count: int, view_counts: Sequence[int]) -> Splits:
    """Every 8th view held out; with fewer than four views none is."""
    return held_out(count, range(0, count, 8) if count >= 4 else [], view_counts)


def dtu(view_counts: Sequence[int]) -> Splits:
    """PixelNeRF's split of DTU's 49 views; "all" trains on every view that is not a test view or excluded."""
    test = [i for i in range(49) if i not in DTU_TRAIN_ORDER + DTU_EXCLUDED]
    few = {str(k): list(DTU_TRAIN_ORDER[:k]) for k in view_counts if k <= len(DTU_TRAIN_ORDER)}
    return {k: {"train": train, "test": list(test)} for k, train in (few | {"all": sorted(DTU_TRAIN_ORDER)}).items()}
