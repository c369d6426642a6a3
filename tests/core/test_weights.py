"""The weights that are shipped are where the package says."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from cat3d_core import weights


@pytest.mark.parametrize("path", [weights.default_model_path, weights.default_sweep_path])
def test_shipped_files_are_there_or_missed_in_a_sentence(
    path: Callable[[], Path], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    assert path().is_file()
    monkeypatch.setattr(weights, "__file__", str(tmp_path / "__init__.py"))
    with pytest.raises(FileNotFoundError, match="is missing"):
        path()
