"""The script for a borrowed GPU, run here on the CPU: a leg, another from its weights, and the way home."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from cat3d_core.diffusion import describe

ROOT = Path(__file__).resolve().parents[2]
SCRIPT = "infra/gpu/lease.sh"
SMALL = "bank.scenes=5 bank.views=8 optimizer.groups=1 sample_scenes=1 sample_steps=1"


def lease(tmp_path: Path, *arguments: str | Path, **variables: str) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"PYTHON": sys.executable, "WORK": str(tmp_path / "work"), "WHEELS": "/nowhere"}
    return subprocess.run(["bash", SCRIPT, *map(str, arguments)], cwd=ROOT, capture_output=True, text=True,
                          env=environment | variables, timeout=900)  # fmt: skip


def test_without_a_verb_it_says_how_it_is_used(tmp_path: Path) -> None:
    done = lease(tmp_path)
    assert done.returncode == 2
    assert "lease.sh train OUT 560" in done.stdout


@pytest.mark.slow
def test_two_legs_and_the_way_home(tmp_path: Path) -> None:
    for leg in (0, 1):
        out = tmp_path / f"out{leg}"
        done = lease(tmp_path, "train", out, "60", SETTINGS=SMALL, RANKS="2", RESERVE="30", SCENES="0")
        assert done.returncode == 0, done.stdout + done.stderr
        assert len(list(out.iterdir())) <= 8
        assert max(path.stat().st_size for path in out.iterdir()) <= 16 * 2**20
    home = tmp_path / "home"
    home.mkdir()
    damaged = out / "default.part.01"
    whole = damaged.read_bytes()
    damaged.write_bytes(whole[:-1])
    assert lease(tmp_path, "join", out, home, home).returncode != 0
    assert not list(home.iterdir()), "nothing is replaced by a damaged file"
    damaged.write_bytes(whole)
    done = lease(tmp_path, "join", out, home, home)
    assert done.returncode == 0, done.stderr
    history = describe(home / "default.safetensors")["provenance"]
    first = describe(tmp_path / "work" / "leg_0" / "model.safetensors")
    assert history["started_from"]["sha256"] == first["sha256"]
    assert "Exported 20" in (home / "model_card.md").read_text()
