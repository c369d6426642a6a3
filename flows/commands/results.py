"""`cat3d results`: print the summary of an output folder, and compare it with another one."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from rich.table import Table

from cat3d_core.metrics import measures
from cat3d_core.metrics.measures import Metric
from cat3d_core.metrics.seeds import Mean
from flows.errors import InputError
from flows.progress import console
from flows.reporting.seeds import change, mean_of, seeds_of
from flows.reporting.summary import mean_text, measured, number, shown_metrics, summary_rows, title

ALL_SCENES = "all scenes"


def results_command(out: Path, against: Path | None) -> int:
    """Print the summary; with `against`, the changes too. Returns the number of regressions."""
    rows = summary_rows(out)
    if not rows:
        raise InputError(f"{out} holds no metrics; give the --out folder of a run or sweep.")
    shown = shown_metrics(rows)
    table = Table("scene", "run", "protocol", *map(title, shown), "seconds", title=str(out))
    for r in rows:
        numbers = [*(measured(r, metric) for metric in shown), number(r["seconds"], 0)]
        table.add_row(r["scene_id"], r["run"], r["protocol"], *numbers)
    console.print(table)
    if seeds_of(rows) > 1:
        console.print(_means(rows, shown))
    return compare(out, against, rows) if against else 0


def _means(rows: Sequence[dict[str, Any]], shown: Sequence[Metric]) -> Table:
    """Over scenes, with standard errors over seeds."""
    table = Table("training views", "method", "protocol", "scenes", "seeds", *map(title, shown),
                  title="means ± standard error over seeds")  # fmt: skip
    for (split, method, protocol), members in _groups(rows):
        numbers = [mean_text(mean_of(members, metric.name), metric.digits) for metric in shown]
        scenes = len({r["scene_id"] for r in members})
        table.add_row(split, method, protocol, str(scenes), str(seeds_of(members)), *numbers)
    return table


def compare(out: Path, against: Path, rows: list[dict[str, Any]] | None = None) -> int:
    """Print the change of every mean over seeds that both folders have; the number of those over all scenes of a method
    that are worse by more than seeds explain (95 %). rows: the summary of `out`, where it is read already.

    With one seed a change cannot be told from noise, which is said and is no regression. A single scene's change is
    marked too, but not counted: of twenty scenes one is beyond 95 % by chance.
    """
    now, before = rows or summary_rows(out), summary_rows(against)
    if not before:
        raise InputError(f"{against} holds no metrics to compare with.")
    table = Table("scene", "views", "method", "protocol", "metric", "before", "now", "change", "",
                  title=f"against {against}")  # fmt: skip
    regressions = compared = untold = 0
    old = dict(_groups(before))
    for key, members in _groups(now):
        for metric in measures.METRICS:
            for scene, new_rows, old_rows in _pairs(_known(members, metric), _known(old.get(key, []), metric), metric):
                found = change(new_rows, old_rows, metric.name)
                if found is None:
                    continue
                verdict = _verdict(found, metric)
                if scene == ALL_SCENES:
                    compared += 1
                    regressions += verdict == "worse"
                    untold += verdict == UNTOLD
                digits = metric.digits if metric.unit == "dB" else metric.digits + 1  # changes are smaller than numbers
                values = [mean_text(mean_of(rows, metric.name), digits) for rows in (old_rows, new_rows)]
                table.add_row(scene, *key, metric.name, *values, found.text(digits, signed=True), _coloured(verdict))
    console.print(table)
    if not compared:
        raise InputError(f"{out} and {against} have no scene, method, split and protocol in common.")
    console.print(f"{regressions} of {compared} means over scenes are worse by more than seeds explain.")
    if untold:
        console.print(
            f"{untold} of them changed, and one seed cannot tell whether that is noise: run both with several seeds "
            "(in a sweep, seeds: [0, 1, 2, 3, 4])."
        )
    return regressions


UNTOLD = "cannot tell: one seed"


def _verdict(found: Mean, metric: Metric) -> str:
    if found.value == 0:
        return ""
    if found.certain is None:
        return UNTOLD
    if not found.certain:
        return "noise"
    return "better" if (found.value > 0) == (metric.better == "higher") else "worse"


def _coloured(verdict: str) -> str:
    return f"[red]{verdict}[/red]" if verdict == "worse" else verdict


def _groups(rows: Sequence[dict[str, Any]]) -> list[tuple[tuple[str, str, str], list[dict[str, Any]]]]:
    """Rows by split, method and protocol."""
    keys = sorted({(r["split"] or "", r["method"] or "", r["protocol"]) for r in rows})
    return [(k, [r for r in rows if (r["split"] or "", r["method"] or "", r["protocol"]) == k]) for k in keys]


def _known(rows: Sequence[dict[str, Any]], metric: Metric) -> list[dict[str, Any]]:
    return [r for r in rows if r[metric.name] is not None]


def _pairs(
    now: list[dict[str, Any]], before: list[dict[str, Any]], metric: Metric
) -> Iterator[tuple[str, list[dict[str, Any]], list[dict[str, Any]]]]:
    """Each scene that both have, and all of these together: (scene, rows now, rows before), measured by one network."""
    if metric.network is not None:
        column = metric.network.column
        if {r[column] for r in now} != {r[column] for r in before}:
            return  # numbers of two networks are not comparable
    scenes = sorted({r["scene_id"] for r in now} & {r["scene_id"] for r in before})
    groups = [(scene, [scene]) for scene in scenes if len(scenes) > 1]
    for name, members in [*groups, (ALL_SCENES, scenes)] if scenes else []:
        yield name, [r for r in now if r["scene_id"] in members], [r for r in before if r["scene_id"] in members]
