"""What `make mutants` found: caught mutants of each room of cat3d_core, and those that nothing noticed."""

from __future__ import annotations

import argparse
import json
from collections import Counter, defaultdict
from collections.abc import Iterable
from pathlib import Path
from typing import Any

CAUGHT = {"caught", "timeout", "died"}
#: Not counted: the compiler makes the same of both, the source has changed since, or the function is not in memory.
NOT_COUNTED = {"same", "stale", "cannot be swapped"}


def rounds(results: Path) -> tuple[dict[str, dict[str, Any]], dict[str, dict[str, Any]]]:
    """The first and the last judgement of each mutant, by its id."""
    first: dict[str, dict[str, Any]] = {}
    last: dict[str, dict[str, Any]] = {}
    for line in results.read_text().splitlines():
        row = json.loads(line)
        first.setdefault(row["id"], row)
        last[row["id"]] = row
    return first, last


def room(row: dict[str, Any]) -> str:
    """The package that a mutant's file is in; `.` for the modules of cat3d_core itself."""
    return Path(row["file"]).relative_to("cat3d_core").parent.as_posix()


def table(first: dict[str, dict[str, Any]], last: dict[str, dict[str, Any]]) -> list[str]:
    """Markdown: mutants and caught ones of each room, at first and now."""
    counts: dict[str, Counter[str]] = defaultdict(Counter)
    for key, row in first.items():
        if row["verdict"] in NOT_COUNTED:
            continue
        for name in (room(row), "all"):
            counts[name]["all"] += 1
            counts[name]["first"] += row["verdict"] in CAUGHT
            counts[name]["last"] += last[key]["verdict"] in CAUGHT | {"stale"}  # stale: its line is gone
    lines = ["| room | mutants | caught at first | caught now |", "|---|---|---|---|"]
    for name in sorted(counts, key=lambda name: (name == "all", name)):
        n = counts[name]
        shares = (f"{n[key]} ({100 * n[key] / n['all']:.0f}%)" for key in ("first", "last"))
        lines.append(f"| {name} | {n['all']} | {' | '.join(shares)} |")
    return lines


def survivors(rows: Iterable[dict[str, Any]]) -> list[str]:
    """Each mutant that nothing noticed, as a difference."""
    lines = []
    for row in sorted(rows, key=lambda row: (row["file"], row["line"])):
        if row["verdict"] in {"survived", "untested"}:
            lines.append(
                f"{row['id']} {row['file']}:{row['line']} {row['function']} ({row['verdict']}, {row['tests']})"
            )
            lines += [f"  - {line.strip()}" for line in row["old"]] + [f"  + {line.strip()}" for line in row["new"]]
    return lines


def main() -> None:
    """Print the table and the survivors."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("results", type=Path)
    parser.add_argument("--survivors", action="store_true")
    options = parser.parse_args()
    first, last = rounds(options.results)
    print("\n".join(table(first, last)))
    print(f"\nVerdicts now: {dict(Counter(row['verdict'] for row in last.values()))}")
    if options.survivors:
        print("\n".join(survivors(last.values())))


if __name__ == "__main__":
    main()
