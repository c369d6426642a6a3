"""Whether given cameras fit their pixels: matches between photos must lie on the epipolar lines of the cameras.

Which photos show the same is found by the photos alone, so that wrong cameras can't choose the pairs. Of each pair the
matches that some epipolar geometry explains (RANSAC) are compared with the given one: points in front of both cameras,
close to their epipolar lines. Points seen in three views must also meet there, which tells the lengths of the ways
between cameras. Views that take part in most contradictions are named.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from cat3d_core.view_selection import evenly
from flows.media.images import read_image
from flows.readers.base import Capture
from flows.sfm.colmap import pycolmap
from flows.sfm.matches import Features, features, matches

# Views looked at: all of a small scene, evenly spaced ones of a larger.
MOST_VIEWS = 48
# Coarse features by which pairs are found; partners of each view that are looked at closely: those with most matches,
# and those with fewest of at least FEWEST.
SCOUTS, NEAR, FAR, FEWEST = 384, 3, 2, 20
# A pair says something from so many matches that agree with one another, and that share of all its matches.
AGREEING, AGREEING_SHARE = 24, 0.35
# Distances from epipolar lines, in 1/800 of the image's long side: of matches that agree, and of those that fit.
AGREEMENT, TOLERANCE = 1.5, 2.0
# Cameras contradict a pair if they explain less than this share of its agreeing matches. More can't be chance: the
# others are then of things that repeat.
EXPLAINED = 0.25
# They also do if of so many matches the middle one is so far off: estimated cameras that drifted apart.
MANY, DRIFTED = 48, (1.0, 20.0)
# Share of a view's pairs that must contradict it, and the least number, before it is named.
NAMED_SHARE, NAMED_LEAST = 0.3, 2
# Parallax from which a point behind a camera, or a third view's disagreement, is evidence: in radians.
PARALLAX = 0.02
# Error in a third view, as a share of the parallax between them, beyond which the three cameras contradict.
THIRD_TOLERANCE = 0.15
SEED = 1


@dataclass(frozen=True)
class Consistency:
    """What the check found. views: how many were looked at; pairs: those that say something, and of them the
    contradictory ones (indices into the capture); triples likewise; blamed: views, worst first; seconds it took."""

    views: int
    pairs: list[tuple[int, int]]
    bad_pairs: list[tuple[int, int]]
    triples: int
    bad_triples: list[tuple[int, int, int]]
    blamed: list[int]
    seconds: float

    def warnings(self, names: Sequence[str]) -> list[str]:
        """Sentences for the user, none where everything fits."""
        checked = f"{len(self.bad_pairs)} of {len(self.pairs)} pairs of photos"
        if not self.blamed:
            return []
        if len(self.bad_pairs) > 0.7 * len(self.pairs):
            return [
                f"Warning: the given cameras do not fit the photos ({checked} contradict them). Wrong axes, an order "
                "of cameras that is not that of the photos, photos turned since, or intrinsics of another size would "
                "do this; --set poses.estimate=always estimates the cameras instead."
            ]
        split = _split(self.bad_pairs)
        if split is not None:
            return [
                f"Warning: the cameras from {names[split]} on do not fit those before it ({checked} contradict them, "
                "nearly all across that view). Take the views on one side of it, correct the cameras, or estimate all "
                "with --set poses.estimate=always."
            ]
        who = ", ".join(names[v] for v in sorted(self.blamed)[:12]) + (" …" if len(self.blamed) > 12 else "")
        also = f" and {len(self.bad_triples)} of {self.triples} triples" if self.bad_triples else ""
        return [
            f"Warning: the cameras of {len(self.blamed)} views do not fit their photos ({checked}{also} contradict "
            f"them): {who}. Leave them out, correct them, or estimate all with --set poses.estimate=always."
        ]


def check_consistency(capture: Capture) -> list[str]:
    """Warnings that name the views whose given cameras do not fit their pixels; none without given cameras."""
    if capture.cameras is None or len(capture) < 2:
        return []
    return measure_consistency(capture).warnings(capture.names)


@dataclass(frozen=True)
class Evidence:
    """What the photos say by themselves: features by view, and for pairs of views that show the same the indices (M) of
    the features in both that some one epipolar geometry explains."""

    found: dict[int, Features]
    agreed: dict[tuple[int, int], tuple[np.ndarray, np.ndarray]]


def measure_consistency(capture: Capture) -> Consistency:
    """The check itself; needs given cameras."""
    started = time.monotonic()
    assert capture.cameras is not None
    known = evidence(capture)
    return judge(capture.cameras.world_from_camera.double().numpy(), known, time.monotonic() - started)


def evidence(capture: Capture) -> Evidence:
    """Features and agreeing matches of up to MOST_VIEWS views, evenly spaced ones of a larger scene."""
    pycolmap.logging.minloglevel = 3
    views = evenly(len(capture), MOST_VIEWS)
    found = {v: features(capture, v, _pixels(capture, v)) for v in views}
    agreed = {}
    for a, b in _candidates(found):
        ia, ib = matches(found[a], found[b])
        kept = _agreeing(found[a].rays[ia], found[b].rays[ib], max(found[a].unit, found[b].unit))
        if kept is not None:
            agreed[a, b] = ia[kept], ib[kept]
    return Evidence(found, agreed)


def judge(poses: np.ndarray, known: Evidence, seconds: float = 0.0) -> Consistency:
    """What the evidence says of poses (N, 4, 4) world_from_camera, OpenCV axes."""
    started = time.monotonic()
    bad, fitting = [], {}
    for (a, b), (ia, ib) in known.agreed.items():
        one, two = known.found[a], known.found[b]
        unit = max(one.unit, two.unit)
        distance, front = _distances(_relative(poses[a], poses[b]), one.rays[ia], two.rays[ib])
        fits = front & (distance < TOLERANCE * unit)
        drift = float(np.median(np.where(front, distance, np.inf))) / unit
        if fits.mean() < EXPLAINED or (len(ia) >= MANY and DRIFTED[0] < drift < DRIFTED[1]):
            bad.append((a, b))
        else:
            fitting[a, b] = (ia[fits], ib[fits])
    triples, bad_triples = _triples(poses, known.found, fitting)
    pairs = list(known.agreed)
    blamed = _blamed([*bad, *bad_triples], [*pairs, *triples])
    seconds += time.monotonic() - started
    return Consistency(len(known.found), pairs, bad, len(triples), bad_triples, blamed, seconds)


def _pixels(capture: Capture, view: int) -> np.ndarray:
    if capture.images is not None:
        return capture.images[view]
    return read_image(capture.paths[view], upright=capture.upright)[0]


def _candidates(found: dict[int, Features]) -> list[tuple[int, int]]:
    """Pairs a < b: for each view the partners with which most of its coarse features match, and the farthest ones, with
    which just enough do: errors add up on the way to those."""
    counts = {(a, b): len(matches(found[a], found[b], SCOUTS)[0]) for a, b in combinations(found, 2)}
    pairs = set()
    for view in found:
        mine = sorted((p for p in counts if view in p and counts[p] >= FEWEST), key=lambda p: -counts[p])
        pairs |= {*mine[:NEAR], *mine[NEAR:][-FAR:]}
    return sorted(pairs)


def _agreeing(a: np.ndarray, b: np.ndarray, unit: float) -> np.ndarray | None:
    """Which matched rays (M, 2) some one epipolar geometry explains, None where too few do to say anything."""
    if len(a) < AGREEING:
        return None
    options = pycolmap.RANSACOptions(
        max_error=AGREEMENT * unit, random_seed=SEED, max_num_trials=3000, min_num_trials=300
    )
    result = pycolmap.estimate_fundamental_matrix(a, b, options)
    if result is None:
        return None
    agreed = np.asarray(result["inlier_mask"])
    return agreed if agreed.sum() >= AGREEING and agreed.mean() >= AGREEING_SHARE else None


def _relative(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(3, 4) points of camera a to camera b, from their world_from_camera."""
    return (np.linalg.inv(b) @ a)[:3]


def _distances(b_from_a: np.ndarray, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of matches (M, 2) the Sampson distance (Hartley and Zisserman, 11.9) to their epipolar lines, as a ray; and
    whether their point is in front of both cameras, as far as the parallax can tell."""
    rotation, way = b_from_a[:, :3], b_from_a[:, 3]
    ha, hb = (np.concatenate([x, np.ones((len(x), 1))], 1) for x in (a, b))
    turned = ha @ rotation.T
    length = np.linalg.norm(way)
    direction = way / length if length > 0 else np.array([1.0, 0, 0])
    lines_b = np.cross(direction, turned)  # epipolar line in b of each ray of a
    lines_a = np.cross(-rotation.T @ direction, hb @ rotation)
    top = np.abs((hb * lines_b).sum(1))
    norm = np.sqrt((lines_b[:, :2] ** 2).sum(1) + (lines_a[:, :2] ** 2).sum(1))
    depth_a, depth_b, parallax = _depths(turned, direction, hb)
    return top / np.maximum(norm, 1e-12), (parallax < PARALLAX) | ((depth_a > 0) & (depth_b > 0))


def _depths(turned: np.ndarray, way: np.ndarray, hb: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Depths (M) in a and b of the points nearest to both rays, depth_a turned + way = depth_b hb, and the angle."""
    aa, bb, ab = (turned**2).sum(1), (hb**2).sum(1), (turned * hb).sum(1)
    ta, tb = turned @ way, hb @ way
    sine2 = np.maximum(aa * bb - ab**2, 1e-18)
    depth_a, depth_b = (ab * tb - bb * ta) / sine2, (aa * tb - ab * ta) / sine2
    return depth_a, depth_b, np.arctan2(np.sqrt(sine2), ab)


def _triples(
    poses: np.ndarray, found: dict[int, Features], fitting: dict[tuple[int, int], tuple[np.ndarray, np.ndarray]]
) -> tuple[list[tuple[int, int, int]], list[tuple[int, int, int]]]:
    """Triples of views whose pairs fit, and those of them whose points do not meet."""
    triples, bad = [], []
    for pair, (ia, ib) in fitting.items():
        for other, (ic, id_) in fitting.items():
            if pair >= other or len(shared := set(pair) & set(other)) != 1:
                continue
            middle = shared.pop()
            first, third = (p[0] if p[1] == middle else p[1] for p in (pair, other))
            of_middle, of_first = (ia, ib) if pair[0] == middle else (ib, ia)
            of_middle_too, of_third = (ic, id_) if other[0] == middle else (id_, ic)
            common, i, j = np.intersect1d(of_middle, of_middle_too, return_indices=True)
            ratio = _length_ratio(
                [_relative(poses[middle], poses[v]) for v in (first, third)],
                found[middle].rays[common],
                [found[first].rays[of_first[i]], found[third].rays[of_third[j]]],
            )
            if ratio is not None:
                triples.append((first, middle, third))
                if abs(np.log(ratio)) > THIRD_TOLERANCE:
                    bad.append((first, middle, third))
    return triples, bad


def _length_ratio(from_middle: list[np.ndarray], rays: np.ndarray, others: list[np.ndarray]) -> float | None:
    """Median ratio of the depths that two other views give the points of the middle one; None where few points have
    parallax to both."""
    depths, clear = [], np.ones(len(rays), bool)
    for relative, other in zip(from_middle, others, strict=True):
        ones = np.ones((len(rays), 1))
        turned, hb = np.concatenate([rays, ones], 1) @ relative[:, :3].T, np.concatenate([other, ones], 1)
        depth, _, parallax = _depths(turned, relative[:, 3], hb)
        depths.append(depth)
        clear &= (parallax > 2 * PARALLAX) & (depth > 0)
    if clear.sum() < AGREEING:
        return None
    return float(np.median(depths[0][clear] / depths[1][clear]))


def _split(bad: Sequence[tuple[int, int]]) -> int | None:
    """The view from which on the cameras contradict those before, None where the contradictions are no such thing."""
    if len(bad) < 6:
        return None
    crossing = {s: sum(a < s <= b for a, b in bad) for s in range(1, max(b for _, b in bad) + 1)}
    most = max(crossing.values())
    best = [s for s, count in crossing.items() if count == most]
    across = [(a, b) for a, b in bad if a < best[0] <= b]
    several = min(len({a for a, _ in across}), len({b for _, b in across})) >= 3
    return best[len(best) // 2] if most >= 0.9 * len(bad) and several else None


def _blamed(bad: Sequence[tuple[int, ...]], checked: Sequence[tuple[int, ...]]) -> list[int]:
    """Few views that take part in all contradictions, found greedily: the one with most of them first. Those with too
    few of their own are not named: what repeats in a scene makes single pairs look wrong."""
    open_, out = list(bad), []
    mine, total = (Counter(v for group in groups for v in group) for groups in (bad, checked))
    while open_:
        count = Counter(v for group in open_ for v in group)
        worst = max(count, key=lambda v: (count[v], count[v] / total[v]))
        out.append(worst)
        open_ = [group for group in open_ if worst not in group]
    return [v for v in out if mine[v] >= min(NAMED_LEAST, total[v]) and mine[v] >= NAMED_SHARE * total[v]]
