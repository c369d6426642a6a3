"""Shared test set-up: threads, a private Prefect home and kernel cache, and the optional real scenes."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import pytest

# Before Prefect is imported anywhere: nothing of a test run goes to the user's own Prefect home.
_HOME = tempfile.mkdtemp(prefix="cat3d-tests-")
os.environ.setdefault("PREFECT_HOME", f"{_HOME}/prefect")
os.environ.setdefault("PREFECT_SERVER_ANALYTICS_ENABLED", "false")
os.environ.setdefault("DO_NOT_TRACK", "1")
os.environ.setdefault("PREFECT_LOGGING_LEVEL", "ERROR")

from hypothesis import HealthCheck, settings  # noqa: E402

# Derandomised: a failure in CI is the same failure at the desk.
settings.register_profile(
    "cat3d", deadline=None, max_examples=40, derandomize=True, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("cat3d")

_SHARED = Path(os.environ.get("CAT3D_SHARED", Path(__file__).resolve().parents[2] / "shared"))


def _shared(folder: str) -> Path:
    path = _SHARED / folder
    if not path.is_dir():
        pytest.skip(f"The shared {folder} folder is not on this machine ({path}); set CAT3D_SHARED to its parent.")
    return path


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of the real captured scenes; skips where they are absent (they are not ours to redistribute)."""
    return _shared("data")


@pytest.fixture(scope="session")
def shared_weights() -> Path:
    """Folder of foreign weights (LPIPS backbone, tiny autoencoder); skips where absent."""
    return _shared("weights")


@pytest.fixture(scope="session")
def shared_fixtures() -> Path:
    """Folder of numbers that other people's code gave; skips where absent (they are not ours to redistribute)."""
    return _shared("fixtures")
