"""`cat3d models` lists what is shipped."""

from __future__ import annotations

import json

import pytest

from cat3d_core.weights import default_model_path, default_sweep_path
from flows.commands.models import models_command


def test_the_model_and_the_plane_sweep_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    models_command(None, None, True)
    reports = {report["path"]: report for report in json.loads(capsys.readouterr().out)}
    assert {str(default_model_path()), str(default_sweep_path())} <= set(reports)
    sweep = reports[str(default_sweep_path())]
    assert {"config", "composite", "provenance", "sha256", "bytes"} <= set(sweep)


def test_lists_of_settings_are_shown_as_they_are(capsys: pytest.CaptureFixture[str]) -> None:
    """Not read as markup: [false, true] would be a style of rich's and vanish."""
    models_command(None, None, False)
    assert '"attention": [' in " ".join(capsys.readouterr().out.replace("│", " ").split())
