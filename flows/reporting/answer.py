"""The answer a report opens with: which method won, by how much, on how many scenes, and what it cost."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from cat3d_core.metrics.seeds import Mean
from flows.reporting.seeds import change
from flows.reporting.summary import mean, method_order, split_order

#: Without a second seed, mean PSNR closer than this (dB) is called equal: seeds alone move a single scene by more.
EQUAL_DB = 0.1


@dataclass(frozen=True)
class Standing:
    """One method on the scenes and seeds of a split that all compared methods did: mean PSNR (dB), mean seconds of a
    run's stages or None where none were timed, and on how many scenes it is the best."""

    method: str
    psnr_db: float
    seconds: float | None
    best_on: int


@dataclass(frozen=True)
class Answer:
    """Methods of one split, the best first, on the same `scenes` scenes; `gain_db` of the best over the second, or None
    where there is nothing to compare with."""

    split: str
    scenes: int
    standings: tuple[Standing, ...]
    gain_db: Mean | None = None

    @property
    def sentence(self) -> str:
        """The answer in words."""
        best, *others = self.standings
        which = f"{self.split} photos" if self.split.isdigit() else f"the split {self.split}"
        where = "one scene" if self.scenes == 1 else f"{self.scenes} scenes"
        if not others:
            return f"With {which}, {best.method} reaches {best.psnr_db:.2f} dB on {where}{_cost(best)}."
        second, gain = others[0], self.gain_db or Mean(best.psnr_db - others[0].psnr_db)
        noise = ""
        if gain.certain is False:
            verb = f"{best.method} and {second.method} are equal within the noise of seeds"
        elif gain.certain is None and abs(gain.value) < EQUAL_DB:
            verb = f"{best.method} and {second.method} are equal"
        else:
            verb = f"{best.method} beats {second.method} by {gain.text(1)} dB"
        if gain.certain is None:
            noise = "; one seed does not say how much of that is noise"
        numbers = f"{best.psnr_db:.2f} against {second.psnr_db:.2f}"
        won = "" if self.scenes == 1 else f", best on {best.best_on} of {self.scenes}"
        return f"With {which}, {verb} ({numbers} on {where}{won}{noise}){_cost(best, second)}."


def _cost(best: Standing, second: Standing | None = None) -> str:
    if best.seconds is None:
        return ""
    against = f" against {second.seconds:.0f} s" if second is not None and second.seconds is not None else ""
    return f"; a run takes {best.seconds:.0f} s{against}"


def answers(rows: Sequence[dict[str, Any]]) -> list[Answer]:
    """An answer for each split, from rows of `summary_rows`, under the paper's protocol where it was measured.

    Only scenes count that every method of the split did, so that means are over the same scenes; a scene's number is
    its mean over seeds.
    """
    protocols = sorted({r["protocol"] for r in rows}, key=lambda p: (p != "google", p))
    known = [r for r in rows if r["protocol"] in protocols[:1] and r["psnr_db"] is not None]
    out = []
    for split in sorted({r["split"] for r in known}, key=split_order):
        here = [r for r in known if r["split"] == split]
        methods = sorted({r["method"] for r in here}, key=method_order)
        by_method = {m: _by_scene([r for r in here if r["method"] == m]) for m in methods}
        common = set.intersection(*(set(scenes) for scenes in by_method.values()))
        if not common:
            continue
        best = {s: max(methods, key=lambda m: by_method[m][s][0]) for s in common}
        standings = [
            Standing(
                method,
                mean([by_method[method][s][0] for s in sorted(common)]) or 0.0,
                mean([by_method[method][s][1] for s in sorted(common)]),
                sum(winner == method for winner in best.values()),
            )
            for method in methods
        ]
        standings.sort(key=lambda s: -s.psnr_db)
        first = [[r for r in here if r["method"] == s.method and r["scene_id"] in common] for s in standings[:2]]
        gain = change(first[0], first[1], "psnr_db") if len(first) == 2 else None
        out.append(Answer(split, len(common), tuple(standings), gain))
    return out


def _by_scene(rows: Sequence[dict[str, Any]]) -> dict[str, tuple[float, float | None]]:
    """Scene -> PSNR and seconds, means over seeds."""
    members: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for row in rows:
        members[row["scene_id"]].append(row)
    return {s: (mean([r["psnr_db"] for r in m]) or 0.0, mean([r["seconds"] for r in m])) for s, m in members.items()}


def rivals(rows: Sequence[dict[str, Any]]) -> dict[tuple[str, str], str]:
    """(scene, run) -> the run to compare it with: of the same scene, split and seed, the best of another method."""
    out = {}
    for row in rows:
        same = [
            other for other in rows
            if all(other[k] == row[k] for k in ("scene_id", "split", "seed", "protocol"))
            and other["method"] != row["method"] and other["psnr_db"] is not None
        ]  # fmt: skip
        if same:
            out[row["scene_id"], row["run"]] = max(same, key=lambda r: r["psnr_db"])["run"]
    return out


def best_runs(rows: Sequence[dict[str, Any]], split: str) -> dict[str, str]:
    """Scene -> its run with the highest PSNR in the split."""
    out: dict[str, dict[str, Any]] = {}
    for row in rows:
        known = row["split"] == split and row["psnr_db"] is not None
        if known and (row["scene_id"] not in out or row["psnr_db"] > out[row["scene_id"]]["psnr_db"]):
            out[row["scene_id"]] = row
    return {scene: row["run"] for scene, row in out.items()}
