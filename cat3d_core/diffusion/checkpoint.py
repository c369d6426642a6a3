"""Checkpoints: safetensors files that carry their configuration and provenance. No pickle."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from cat3d_core.diffusion.autoencoder import ENCODER
from cat3d_core.diffusion.config import ModelConfig
from cat3d_core.diffusion.model import MultiViewModel
from cat3d_core.weights_file import exported, read_weights, weights_hash, write_weights

FORMAT = "cat3d.multiview.1"


def save_model(
    path: str | Path, model: MultiViewModel, provenance: dict[str, Any], dtype: torch.dtype | None = None
) -> str:
    """Write U-Net, autoencoder, configuration and provenance (JSON values: data, steps, licence ...) to one file.

    dtype: convert floating-point weights (torch.float16 to ship). Returns the weights' hash, which is also in the file.
    The file appears under its name only when it is complete.
    """
    state = exported(model.state_dict(), dtype, Path(path))
    digest = weights_hash(state)
    encoder = tuple(f"autoencoder.{name}" for name in ENCODER)
    metadata = {
        "format": FORMAT,
        "config": model.config.to_json(),
        "provenance": json.dumps(provenance, sort_keys=True),
        "sha256": digest,
        "encoder_sha256": weights_hash({name: t for name, t in state.items() if name.startswith(encoder)}),
    }
    write_weights(Path(path), state, metadata)
    return digest


def load_model(
    path: str | Path, device: torch.device | str = "cpu", dtype: torch.dtype = torch.float32, check: bool = True
) -> MultiViewModel:
    """The model of a checkpoint, in eval mode. check: verify the weights against the hash in the file.

    Raises ValueError if the file is not such a checkpoint, is damaged, or lacks weights; FileNotFoundError if absent.
    """
    metadata, state = read_weights(Path(path))
    if metadata.get("format") != FORMAT:
        raise ValueError(f"{path} is no cat3d model: its format is {metadata.get('format')!r}, expected {FORMAT!r}.")
    if check and weights_hash(state) != metadata["sha256"]:
        raise ValueError(
            f"{path} is damaged: its weights don't have the hash recorded in it. Fetch or export it again."
        )
    with torch.device("meta"):
        model = MultiViewModel(ModelConfig.from_json(metadata["config"]))
    missing = sorted(set(model.state_dict()) ^ set(state))
    if missing:
        raise ValueError(
            f"{path} doesn't fit its configuration; weights missing or left over: {', '.join(missing[:5])}."
        )
    model.load_state_dict({name: t.to(dtype) if t.is_floating_point() else t for name, t in state.items()}, assign=True)
    return model.to(device).eval().requires_grad_(False)


def describe(path: str | Path) -> dict[str, Any]:
    """Configuration, provenance and hashes of a model file, without loading its weights: `sha256` of all of them,
    `encoder_sha256` of those that make latents (older files do not say it; `sha256` stands for it there)."""
    metadata, _ = read_weights(Path(path), weights=False)
    if metadata.get("format") != FORMAT:
        raise ValueError(f"{path} is no cat3d model: its format is {metadata.get('format')!r}, expected {FORMAT!r}.")
    return {
        "config": json.loads(metadata["config"]),
        "provenance": json.loads(metadata["provenance"]),
        "sha256": metadata["sha256"],
        "encoder_sha256": metadata.get("encoder_sha256", metadata["sha256"]),
    }


def save_state(path: str | Path, state: dict[str, Tensor], metadata: dict[str, Any]) -> None:
    """Write tensors and JSON metadata (a trainer's state) to one file."""
    write_weights(
        Path(path), {k: t.detach().cpu().contiguous() for k, t in state.items()}, {"state": json.dumps(metadata)}
    )


def load_state(path: str | Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """What `save_state` wrote."""
    metadata, state = read_weights(Path(path))
    if "state" not in metadata:
        raise ValueError(f"{path} is no saved training state.")
    return state, json.loads(metadata["state"])
