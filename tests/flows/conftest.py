"""One Prefect server for all flow tests, and a scene small enough to run end to end in seconds."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SCENE = "procedural:dtu/3?views=9&width=32&height=24"
TINY = [
    "--set", "render.path_views=2", "--views", "3",
    "--set", "reconstruct.overrides={iterations: 8, batch_rays: 64, samples: [8, 8], grid_max: [32, 64], "
    "grid_features: [1, 2], interlevel_blur: [0.03], grid_log2_table: 10, warmup_iterations: 2, lpips_weight: 0.0}",
]  # fmt: skip


@pytest.fixture(scope="session")
def prefect_url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """A running Prefect server in a folder of its own, found by flows in this process and in those it starts."""
    from flows.pipeline.server import prefect_server

    with prefect_server(tmp_path_factory.mktemp("prefect")) as url:
        yield url


@pytest.fixture
def cat3d(prefect_url: str) -> Callable[..., subprocess.CompletedProcess[str]]:
    """Run the `cat3d` command in a process of its own, as a user does."""

    def call(*arguments: str, check: bool = True, timeout: float = 240) -> subprocess.CompletedProcess[str]:
        done = subprocess.run(
            command(*arguments), cwd=ROOT, env=environment(), capture_output=True, text=True, timeout=timeout
        )
        if check:
            assert done.returncode == 0, done.stdout + done.stderr
        return done

    return call


def command(*arguments: str) -> list[str]:
    return [sys.executable, "-m", "flows.cli", *arguments]


def environment() -> dict[str, str]:
    return os.environ | {"COLUMNS": "200", "OMP_NUM_THREADS": "1"}
