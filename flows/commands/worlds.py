"""`cat3d worlds`: fetch the package of textured worlds, say what is in it, photograph the held-out tracks."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from pathlib import Path

from flows.progress import console, meter
from flows.training.worlds.held_out import make_held_out_worlds
from flows.training.worlds.licences import Licences, table
from flows.training.worlds.package import HELD_OUT, PACKAGE, TRAINING, copyright_file, data_folder, fetch
from flows.training.worlds.shards import SHARD_GROUPS, open_track, shard_numbers

LICENCES = "licences.md"


def worlds_command(package: Path, held_out: Path | None, groups: int, views: int, size: int) -> None:
    """Do what is missing of it. Raises InputError, in a sentence."""
    if not (package / "usr").exists():
        console.print(f"Fetching {PACKAGE} into {package} (628 MB) ...")
        fetch(package)
    data_folder(package)
    if not (package / LICENCES).exists():
        with meter("read tracks", len(TRAINING) + len(HELD_OUT)) as bar:
            text = licence_page(package, bar.advance)
        (package / LICENCES).write_text(text)
    console.print(f"{len(TRAINING)} tracks to train on, {len(HELD_OUT)} held out; licences: {package / LICENCES}")
    console.print(f"Train with --set bank.worlds={package}")
    if held_out is not None:
        with meter("photograph held-out worlds", SHARD_GROUPS * len(shard_numbers(groups))) as bar:
            make_held_out_worlds(held_out, package, groups, views, size, bar.advance)
        console.print(f"Evaluate with: python -m flows.training.evaluation MODEL --worlds {held_out}")


def licence_page(package: Path, advance: Callable[[int], None]) -> str:
    """Markdown: which files of the package the worlds are made of, by licence, and of which tracks."""
    licences, root = Licences(copyright_file(package)), package / "usr/share/games/supertuxkart"
    used: set[str] = set()
    lines = []
    for name in (*TRAINING, *HELD_OUT):
        files = [str(path.relative_to(root)) for path in open_track(package, name).world.files]
        used.update(files)
        count = Counter(licences.of(path).name for path in files)
        shares = ", ".join(f"{licence} ({number})" for licence, number in count.most_common())
        lines.append(f"| {name} | {'held out' if name in HELD_OUT else 'training'} | {shares} |")
        advance(1)
    return "\n".join(
        [
            f"# What the worlds of {PACKAGE} are made of", "",
            "Meshes and textures that are read, by the licences of the package's own copyright file. Where no file is",
            "named there, the package as a whole is GPL-3+.", "",
            table(licences, sorted(used)), "| track | used for | licences (files) |", "|---|---|---|", *lines, "",
        ]
    )  # fmt: skip
