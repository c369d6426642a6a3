"""The weights that are shipped with the package. See README.md beside this file for what they are."""

from __future__ import annotations

from pathlib import Path


def default_sweep_path() -> Path:
    """The shipped plane sweep's file. Raises FileNotFoundError in a checkout or build that lacks it."""
    path = Path(__file__).with_name("sweep.safetensors")
    if not path.is_file():
        raise FileNotFoundError(
            f"This installation carries no plane sweep ({path} is missing): install the package again, train one with "
            "`cat3d train sweep`, or go without (`--set hints.use=never`)."
        )
    return path


def default_model_path() -> Path:
    """The shipped model's file. Raises FileNotFoundError in a checkout or build that lacks it."""
    path = Path(__file__).with_name("default.safetensors")
    if not path.is_file():
        raise FileNotFoundError(
            f"This installation carries no default model ({path} is missing): install the package again, train one "
            "with `cat3d train default`, or name a model file."
        )
    return path
