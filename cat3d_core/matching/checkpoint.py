"""Files of the plane sweep's network: safetensors with its configuration and provenance."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch

from cat3d_core.matching.composite import Composite
from cat3d_core.matching.config import SweepConfig
from cat3d_core.matching.network import SweepNetwork
from cat3d_core.weights_file import exported, read_weights, weights_hash, write_weights

FORMAT = "cat3d.sweep.1"


def save_sweep(
    path: str | Path, network: SweepNetwork, provenance: dict[str, Any], composite: Composite | None = None,
    dtype: torch.dtype | None = None,
) -> str:  # fmt: skip
    """Write weights, configuration, how to composite, and provenance (JSON values) to one file.

    dtype: convert the weights (torch.float16 to ship). Returns the weights' hash, which is also in the file."""
    state = exported(network.state_dict(), dtype, Path(path))
    digest = weights_hash(state)
    metadata = {
        "format": FORMAT, "config": network.config.to_json(), "composite": (composite or Composite()).to_json(),
        "provenance": json.dumps(provenance, sort_keys=True), "sha256": digest,
    }  # fmt: skip
    write_weights(Path(path), state, metadata)
    return digest


def load_sweep(path: str | Path, device: torch.device | str = "cpu", check: bool = True) -> SweepNetwork:
    """The network of a file, float32, in eval mode, with its `composite`. check: verify the weights against the hash.

    Raises ValueError if the file is not such a network's, is damaged, or lacks weights; FileNotFoundError if absent."""
    metadata, state = read_weights(Path(path))
    _is_sweep(path, metadata)
    if check and weights_hash(state) != metadata["sha256"]:
        raise ValueError(
            f"{path} is damaged: its weights don't have the hash recorded in it. Fetch or export it again."
        )
    network = SweepNetwork(SweepConfig.from_json(metadata["config"]))
    missing = sorted(set(network.state_dict()) ^ set(state))
    if missing:
        raise ValueError(
            f"{path} doesn't fit its configuration; weights missing or left over: {', '.join(missing[:5])}."
        )
    network.load_state_dict(state)
    network.composite = Composite.from_json(metadata["composite"])
    return network.to(device).eval().requires_grad_(False)


def describe_sweep(path: str | Path) -> dict[str, Any]:
    """Configuration, provenance and hash of a file, without loading its weights."""
    metadata, _ = read_weights(Path(path), weights=False)
    _is_sweep(path, metadata)
    return {name: json.loads(metadata[name]) for name in ("config", "composite", "provenance")} | {
        "sha256": metadata["sha256"]
    }


def _is_sweep(path: str | Path, metadata: dict[str, str]) -> None:
    if metadata.get("format") != FORMAT:
        raise ValueError(f"{path} is no plane sweep: its format is {metadata.get('format')!r}, expected {FORMAT!r}.")
