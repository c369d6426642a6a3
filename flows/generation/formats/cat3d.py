"""Model files of ours: one safetensors file with U-Net, autoencoder, configuration and provenance (`cat3d train`)."""

from __future__ import annotations

from pathlib import Path

import torch

from cat3d_core.diffusion import describe as facts_of
from cat3d_core.diffusion import load_model
from cat3d_core.diffusion.config import ModelConfig, from_dict
from cat3d_core.generation import Cat3dGenerator, GeneratorSpec, cat3d_spec
from cat3d_core.weights import default_model_path
from flows.errors import InputError
from flows.jobs.device import exact_device

LOOKS_FOR = "a .safetensors file that `cat3d train` wrote, such as the one shipped"


def recognises(path: Path) -> bool:
    """Whether it is a safetensors file of our format."""
    if not path.is_file():
        return False
    try:
        facts_of(path)
    except ValueError:
        return False
    return True


def describe(path: Path | None) -> GeneratorSpec:
    """What the file (None: the shipped one) says of itself. Raises ValueError for a file that is no such model."""
    facts = facts_of(_file(path))
    advice = facts["provenance"].get("sampler", {})
    try:
        return cat3d_spec(from_dict(ModelConfig, facts["config"]), facts["sha256"], facts["encoder_sha256"], advice)
    except TypeError as error:
        raise ValueError(f"{path} recommends a sampler with settings that don't exist here: {error}.") from None


def load(path: Path | None, device: str, precision: str) -> Cat3dGenerator:
    """The model on `device`, checked against its hash; `precision` is the U-Net's, the autoencoder stays in float32.

    Raises ValueError for a file that is damaged or no such model."""
    # The network computes relative cameras in float64.
    model = load_model(_file(path), exact_device() if device == "mps" else device)
    model.unet.to(getattr(torch, precision))
    return Cat3dGenerator(model, describe(path))


def _file(path: Path | None) -> Path:
    try:
        return path or default_model_path()
    except FileNotFoundError as error:
        raise InputError(f"{error} The setting for that is sample.checkpoint.") from None
