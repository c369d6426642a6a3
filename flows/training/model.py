"""The model that a training starts from: configuration, autoencoder, starting weights."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import torch

from cat3d_core.diffusion import SIZES, Autoencoder, ModelConfig, MultiViewModel, UNetConfig, describe, load_model
from cat3d_core.diffusion.config import from_dict
from cat3d_core.diffusion.pretrained import load_stable_diffusion
from flows.generation.formats.cat3d import recognises


def model_config(
    size: str,
    image_size: int | None = None,
    views: int = 8,
    unet: dict[str, Any] | None = None,
    autoencoder: dict[str, Any] | None = None,
    schedule: dict[str, Any] | None = None,
) -> ModelConfig:
    """A built-in size with fields replaced. Raises ValueError naming a field that doesn't exist or fit."""
    document = dataclasses.asdict(SIZES[size])
    document["views"] = views
    if image_size is not None:
        document["unet"]["latent_size"] = image_size // 8
    for part, changes in (("unet", unet), ("autoencoder", autoencoder), ("schedule", schedule)):
        document[part] |= changes or {}
    return from_dict(ModelConfig, document)


def starting_config(config: ModelConfig, start: Path | None) -> ModelConfig:
    """`config`, or where the weights of another program's U-Net come in, that network's layout with our cameras and
    views. Raises ValueError for a model file of ours with another U-Net."""
    if start is None:
        return config
    if recognises(start):
        theirs = load_model(start).config
        # These have no weights: a network may take up relative cameras or larger images in the middle of its training.
        free = {name: getattr(config.unet, name) for name in ("relative_cameras", "latent_size")}
        if not theirs.unet.hints:  # the channels for them start as zero
            free["hints"] = config.unet.hints
        if dataclasses.replace(theirs.unet, **free) != config.unet:
            raise ValueError(f"{start} holds another U-Net than the one asked for: {_differences(theirs, config)}.")
        return config
    return dataclasses.replace(config, unet=_from_stable_diffusion(start, config)[0].config)


def starting_model(config: ModelConfig, autoencoder: Autoencoder, start: Path | None, seed: int) -> MultiViewModel:
    """The model at step 0; `config` as `starting_config` gives it. Random weights depend on the seed alone."""
    torch.manual_seed(seed)
    model = MultiViewModel(config)
    model.autoencoder = autoencoder
    if start is None:
        # No pretrained network has to be kept as it is: let the rays in from the first step.
        torch.nn.init.kaiming_uniform_(model.unet.conv_in.weight, a=5**0.5)
    elif recognises(start):
        model.unet.load_state_dict(_with_hints(load_model(start).unet.state_dict(), config.unet))
    else:
        model.unet = _from_stable_diffusion(start, config)[0]
    return model


def history(start: Path) -> dict[str, Any]:
    """What is to be remembered of the weights that a training starts from: which they are, and what they had seen."""
    if not recognises(start):
        return {"file": start.name}
    facts = describe(start)
    kept = ("steps", "groups_of_views", "groups_of_8_views", "hours", "started_from")
    return {"sha256": facts.get("sha256")} | {k: facts["provenance"][k] for k in kept if k in facts["provenance"]}


def _with_hints(state: dict[str, torch.Tensor], unet: UNetConfig) -> dict[str, torch.Tensor]:
    """Weights of a network without hints for one with them: its further input channels, the last, are zero."""
    weight = state["conv_in.weight"]
    missing = unet.input_channels - weight.shape[1]
    return state | {"conv_in.weight": torch.nn.functional.pad(weight, (0, 0, 0, 0, 0, missing))}


def _from_stable_diffusion(path: Path, config: ModelConfig) -> Any:
    kept = ("latent_channels", "latent_size", "view_attention", "max_3d_size", "decoder_only", "camera", "ray_octaves",
            "relative_cameras", "hints")  # fmt: skip
    changes = {name: getattr(config.unet, name) for name in kept}
    return load_stable_diffusion(path, **changes)


def _differences(theirs: ModelConfig, ours: ModelConfig) -> str:
    one, other = dataclasses.asdict(theirs.unet), dataclasses.asdict(ours.unet)
    return ", ".join(f"{name} is {one[name]} there and {other[name]} here" for name in one if one[name] != other[name])
