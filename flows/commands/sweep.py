"""`cat3d sweep`: load the sweep (a file or a shipped one), run it, report failures."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from flows.errors import InputError
from flows.progress import console
from schemas.config import SweepConfig, load_config, parse_config
from schemas.settings import merged, settings_document

SHIPPED = Path(__file__).parents[1] / "sweeps"


def list_sweeps() -> None:
    """Print the shipped sweeps."""
    for path in sorted(SHIPPED.glob("*.yaml")):
        sweep = load_config(path, SweepConfig)
        console.print(f"[bold]{path.stem}[/bold]  {len(sweep.scenes)} scenes. {sweep.note}")


def sweep_command(config: str, out: Path, config_file: Path | None = None, settings: Sequence[str] = ()) -> list[str]:
    """Do what is missing of a sweep. Returns a sentence for each run that failed, said on stderr too. config_file,
    settings: further settings of all runs, over those of the sweep's `base`."""
    from flows.pipeline.sweep import run_sweep

    given = load_config(config_file).model_dump(mode="json", exclude_unset=True) if config_file else {}
    sweep = with_settings(named_sweep(config), merged(given, settings_document(settings)))
    problems = run_sweep(sweep, out)
    for sentence in problems:
        print(f"cat3d: {sentence}", file=sys.stderr)
    return problems


def named_sweep(name: str) -> SweepConfig:
    """The sweep in a file, or the shipped one of this name. Raises InputError, ConfigError."""
    path = Path(name)
    if not path.exists():
        path = SHIPPED / f"{Path(name).stem}.yaml"
    if not path.exists():
        known = ", ".join(sorted(p.stem for p in SHIPPED.glob("*.yaml")))
        raise InputError(f"{name} is neither a file nor a shipped sweep; shipped are {known}.")
    sweep: SweepConfig = load_config(path, SweepConfig)
    return sweep


def with_settings(sweep: SweepConfig, settings: dict[str, Any]) -> SweepConfig:
    """The sweep with further settings for all of its runs, over those of its `base`. Raises ConfigError."""
    base = merged(sweep.base, settings)
    parse_config(base, "the settings")  # what is wrong is said now, not once for each method
    return sweep.model_copy(update={"base": base})
