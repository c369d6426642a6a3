"""Stable Diffusion 1.x / 2.x U-Nets as a start: read from a local path, inflate, and account for every weight."""

from __future__ import annotations

import dataclasses
import json
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor

from cat3d_core.diffusion.config import UNetConfig
from cat3d_core.diffusion.ldm_names import from_ldm
from cat3d_core.diffusion.unet import MultiViewUNet
from cat3d_core.seva.checkpoint import NO_START, find_seva, is_seva

_TEXT = re.compile(r"(.*\.transformer_blocks\.\d+)\.(attn2|norm2)\.")


@dataclass
class Report:
    """Where every weight went. taken: as it is; widened: got new input channels, zero; folded: text attention that
    became a bias; left: in the file, of no use here; fresh: in the network only, at their initial values."""

    taken: list[str] = field(default_factory=list)
    widened: list[str] = field(default_factory=list)
    folded: list[str] = field(default_factory=list)
    left: list[str] = field(default_factory=list)
    fresh: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        return ", ".join(f"{len(getattr(self, f.name))} {f.name}" for f in dataclasses.fields(self))


def load_stable_diffusion(
    path: str | Path, text_token: Tensor | None = None, **changes: Any
) -> tuple[MultiViewUNet, Report]:
    """The U-Net of a diffusers folder (the pipeline's or its `unet`) or of a single safetensors file.

    text_token [D]: the constant token whose cross-attention is folded into biases (default zeros); changes: fields of
    UNetConfig that differ from the file's network (e.g. max_3d_size=64, decoder_only=True). Heads come from config.json
    where there is one; else from the shapes: convolutional projections mean SD 1.x (8 heads at every level), linear
    ones SD 2.x (64 channels a head). Raises ValueError for files that are no such U-Net, naming the first odd weight.
    """
    weights, heads = _read(Path(path))
    config = dataclasses.replace(_infer_config(weights, heads, path), **changes)
    unet = MultiViewUNet(config)
    report = inflate(unet, weights, text_token)
    return unet, report


@torch.no_grad()
def inflate(unet: MultiViewUNet, weights: dict[str, Tensor], text_token: Tensor | None = None) -> Report:
    """Put a 2D U-Net's weights (diffusers keys) into a multi-view one; returns what went where.

    Text attention on one constant token adds to_out(to_v(token)) to every token whatever the query (softmax over one
    key is 1), so it joins the bias of the self-attention before it: exact, and no parameter is left over.
    """
    report = Report()
    own = dict(unet.named_parameters())
    for name, value in weights.items():
        text = _TEXT.match(name)
        if name in own and own[name].shape == value.shape:
            own[name].copy_(value)
            report.taken.append(name)
        elif name == "conv_in.weight" and value.shape[1] <= unet.config.latent_channels:
            own[name].zero_()
            own[name][:, : value.shape[1]] = value
            report.widened.append(name)
        elif text and unet.config.camera == "raymap":
            report.folded.append(name)
        elif text or name.startswith("conv_out."):  # another context width, or other latents
            report.left.append(name)
        else:
            shape = tuple(own[name].shape) if name in own else None
            raise ValueError(
                f"Weight {name} {tuple(value.shape)} has no place in this U-Net (expected {shape}); "
                "the file is no Stable Diffusion 1.x or 2.x U-Net, or its configuration was changed too far."
            )
    for block in sorted({m[1] for name in report.folded if (m := _TEXT.match(name))}):
        bias = weights[f"{block}.attn2.to_out.0.bias"].float()
        if text_token is not None:
            value = weights[f"{block}.attn2.to_v.weight"].float() @ text_token.float()
            bias = bias + weights[f"{block}.attn2.to_out.0.weight"].float() @ value
        own[f"{block}.attn1.to_out.0.bias"].add_(bias)
    present = set(report.taken) | set(report.widened)
    report.fresh = [name for name in own if name not in present]
    return report


def export_2d(unet: MultiViewUNet, latent_channels: int | None = None) -> dict[str, Tensor]:
    """The 2D network inside: diffusers keys; raymap, mask and hint channels cut off; text attention that adds nothing
    left out. `inflate` of the result gives the same network as long as rays and mask had no effect yet."""
    keep = latent_channels or unet.config.latent_channels
    state = {k: v.detach().clone() for k, v in unet.state_dict().items() if "_views." not in k}
    state["conv_in.weight"] = state["conv_in.weight"][:, :keep]
    return state


def _read(path: Path) -> tuple[dict[str, Tensor], Any]:
    """Weights with diffusers keys, and the heads entry of config.json (None if there is no such file)."""
    folder = path / "unet" if (path / "unet").is_dir() else path
    file = path
    if path.is_dir():
        found = sorted(folder.glob("diffusion_pytorch_model*.safetensors"))
        if not found:
            if (seva := find_seva(path)) is not None:
                raise ValueError(NO_START.format(path=seva))
            raise ValueError(f"There is no diffusion_pytorch_model*.safetensors in {folder}.")
        file = next((f for f in found if f.name == "diffusion_pytorch_model.safetensors"), found[0])
    if not file.is_file():
        raise FileNotFoundError(f"There is no weights file or folder {path}.")
    try:
        weights = load_file(file)
    except SafetensorError as error:
        raise ValueError(f"{file} is not a readable safetensors file ({error}).") from error
    prefix = "model.diffusion_model."
    if any(k.startswith(prefix) for k in weights):
        weights = {k[len(prefix) :]: v for k, v in weights.items() if k.startswith(prefix)}
    if is_seva({name: tuple(t.shape) for name, t in weights.items()}):
        raise ValueError(NO_START.format(path=file))
    if "input_blocks.0.0.weight" in weights:
        try:
            ours = from_ldm(weights)
        except ValueError as error:
            raise ValueError(f"{file} holds no Stable Diffusion U-Net: {error}.") from None
        weights = {ours[name]: value for name, value in weights.items()}
    heads = None
    if (folder / "config.json").is_file():
        description = json.loads((folder / "config.json").read_text())
        # In diffusers' U-Net the field attention_head_dim holds the NUMBER of heads (a misnomer kept for old files).
        heads = description.get("num_attention_heads") or description.get("attention_head_dim")
    return weights, heads


def _infer_config(weights: dict[str, Tensor], heads: Any, path: str | Path) -> UNetConfig:
    levels = 0
    while f"down_blocks.{levels}.resnets.0.conv1.weight" in weights:
        levels += 1
    if not levels or "conv_in.weight" not in weights:
        raise ValueError(f"{path} holds no Stable Diffusion U-Net: it has no down_blocks or input_blocks.")
    channels = tuple(weights[f"down_blocks.{i}.resnets.0.conv1.weight"].shape[0] for i in range(levels))
    blocks = 0
    while f"down_blocks.0.resnets.{blocks}.conv1.weight" in weights:
        blocks += 1
    linear = weights["mid_block.attentions.0.proj_in.weight"].dim() == 2
    if heads is None:
        heads = [c // 64 for c in channels] if linear else 8
    if isinstance(heads, int):
        heads = [heads] * levels
    return UNetConfig(
        latent_channels=weights["conv_in.weight"].shape[1],
        channels=channels,
        blocks=blocks,
        attention=tuple(f"down_blocks.{i}.attentions.0.norm.weight" in weights for i in range(levels)),
        heads=tuple(heads),
        linear_projection=linear,
        cross_attention_dim=weights["mid_block.attentions.0.transformer_blocks.0.attn2.to_k.weight"].shape[1],
    )
