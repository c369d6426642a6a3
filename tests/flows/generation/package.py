"""Installs a package of someone else's for a test: its modules and metadata in a folder that Python looks in."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

DOCS = Path(__file__).resolve().parents[3] / "docs"


def code_of(guide: str) -> str:
    """The module that a guide in docs/ shows: its first block of Python."""
    found = re.search(r"^```python\n(.*?)^```", (DOCS / guide).read_text(), re.DOTALL | re.MULTILINE)
    assert found is not None, f"{guide} shows no module"
    return found[1]


def install(folder: Path, monkeypatch: pytest.MonkeyPatch, name: str, group: str, code: str) -> None:
    """The module `name` with `code`, and a distribution of that name whose entry point in `group` is the module."""
    folder.mkdir(exist_ok=True)
    (folder / f"{name}.py").write_text(code)
    metadata = folder / f"{name}-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    (metadata / "entry_points.txt").write_text(f"[{group}]\n{name} = {name}\n")
    monkeypatch.syspath_prepend(str(folder))
