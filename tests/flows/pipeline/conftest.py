"""The model of random weights that runs of this folder sample with."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.flows.workers.scene import random_model


@pytest.fixture(scope="session")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return random_model(tmp_path_factory.mktemp("model") / "tiny.safetensors")
