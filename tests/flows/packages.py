"""Installs the package that a guide shows, as pip would leave it in a folder where Python looks."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

GUIDES = Path(__file__).resolve().parents[2] / "docs" / "guides"


def code_of(guide: str) -> str:
    """The module that a guide shows: its block of Python."""
    found = re.search(r"^```python\n(.*?)^```", (GUIDES / guide).read_text(), re.DOTALL | re.MULTILINE)
    assert found is not None, f"{guide} shows no module"
    return found[1]


def entry_of(guide: str, group: str) -> tuple[str, str]:
    """The entry point that a guide declares in `group`: its name, and what it names."""
    pattern = rf'^\[project\.entry-points\."{re.escape(group)}"\]\n(\w+) = "(.+)"$'
    found = re.search(pattern, (GUIDES / guide).read_text(), re.MULTILINE)
    assert found is not None, f"{guide} declares no entry point in {group}"
    return found[1], found[2]


def install(folder: Path, monkeypatch: pytest.MonkeyPatch, group: str, entry: tuple[str, str], code: str) -> None:
    """A module with `code`, and the metadata of a distribution with one entry point in `group`: name = target."""
    name, target = entry
    module = target.partition(":")[0]
    metadata = folder / f"{module}-1.0.dist-info"
    metadata.mkdir(parents=True)
    (folder / f"{module}.py").write_text(code)
    (metadata / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {module}\nVersion: 1.0\n")
    (metadata / "entry_points.txt").write_text(f"[{group}]\n{name} = {target}\n")
    monkeypatch.syspath_prepend(str(folder))


def install_guide(folder: Path, monkeypatch: pytest.MonkeyPatch, guide: str, group: str) -> str:
    """The package of a guide; the name of its entry point."""
    entry = entry_of(guide, group)
    install(folder, monkeypatch, group, entry, code_of(guide))
    return entry[0]
