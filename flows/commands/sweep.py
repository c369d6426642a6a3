"""`cat3d sweep`: load the sweep (a file or a shipped one), run it, report failures."""

from __future__ import annotations

import sys
from pathlib import Path

from flows.errors import InputError
from flows.progress import console
from schemas.config import SweepConfig, load_config

SHIPPED = Path(__file__).parents[1] / "sweeps"


def sweep_command(config: str, out: Path, list_shipped: bool) -> int:
    """Exit code: 0 when every run is complete, 1 when some failed (each with a sentence on stderr)."""
    if list_shipped or not config:
        for path in sorted(SHIPPED.glob("*.yaml")):
            sweep = load_config(path, SweepConfig)
            console.print(f"[bold]{path.stem}[/bold]  {len(sweep.scenes)} scenes. {sweep.note}")
        return 0
    path = Path(config)
    if not path.exists():
        path = SHIPPED / f"{Path(config).stem}.yaml"
    if not path.exists():
        known = ", ".join(sorted(p.stem for p in SHIPPED.glob("*.yaml")))
        raise InputError(f"{config} is neither a file nor a shipped sweep; shipped are {known}.")
    from flows.pipeline.sweep import run_sweep

    problems = run_sweep(load_config(path, SweepConfig), out)
    for sentence in problems:
        print(f"cat3d: {sentence}", file=sys.stderr)
    return 1 if problems else 0
