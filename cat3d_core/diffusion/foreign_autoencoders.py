"""Other people's autoencoders, read from local folders: diffusers' AutoencoderKL and AutoencoderTiny (TAESD family).

Both offer what our own does: encode(images [B, 3, H, W] in [0, 1]) -> latents, decode(latents) -> images in [0, 1].
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from safetensors.torch import load_file
from torch import Tensor, nn

from cat3d_core.diffusion.layers import Downsample, ResnetBlock, Upsample


def load_autoencoder(path: str | Path) -> KLAutoencoder | TinyAutoencoder:
    """A diffusers `vae` folder (config.json and one safetensors file). Raises ValueError if it is of another kind."""
    folder = Path(path)
    if not (folder / "config.json").is_file():
        raise FileNotFoundError(f"{folder} is no autoencoder folder: it has no config.json.")
    config = json.loads((folder / "config.json").read_text())
    files = sorted(folder.glob("diffusion_pytorch_model*.safetensors"))
    if not files:
        raise ValueError(f"There is no diffusion_pytorch_model*.safetensors in {folder}.")
    weights = load_file(files[0])
    kind = config.get("_class_name")
    if kind == "AutoencoderTiny":
        parts = [
            {k[len(p) :]: v for k, v in weights.items() if k.startswith(p)}
            for p in ("encoder.layers.", "decoder.layers.")
        ]
        return TinyAutoencoder(*parts)
    if kind == "AutoencoderKL":
        model = KLAutoencoder(config)
        model.load_state_dict(_modern_names(weights))
        return model.eval().requires_grad_(False)
    raise ValueError(f"{folder} holds a {kind}; AutoencoderKL and AutoencoderTiny can be read.")


def load_taesd(encoder: str | Path, decoder: str | Path) -> TinyAutoencoder:
    """The two files of the original TAESD layout."""
    return TinyAutoencoder(load_file(encoder), load_file(decoder))


class KLAutoencoder(nn.Module):
    """The Stable Diffusion autoencoder. Latents are the posterior's mean, shifted and scaled as the config says."""

    def __init__(self, config: dict[str, Any]) -> None:
        super().__init__()
        widths, layers = config["block_out_channels"], config["layers_per_block"]
        groups, latent = config.get("norm_num_groups", 32), config["latent_channels"]
        self.scale = float(config.get("scaling_factor") or 1.0)
        self.shift = float(config.get("shift_factor") or 0.0)
        self.encoder = _KLHalf(3, 2 * latent, widths, layers, groups, encoder=True)
        self.decoder = _KLHalf(latent, 3, widths[::-1], layers + 1, groups, encoder=False)
        self.quant_conv = nn.Conv2d(2 * latent, 2 * latent, 1) if config.get("use_quant_conv", True) else nn.Identity()
        self.post_quant_conv = (
            nn.Conv2d(latent, latent, 1) if config.get("use_post_quant_conv", True) else nn.Identity()
        )

    def encode(self, images: Tensor) -> Tensor:
        mean = self.quant_conv(self.encoder(images * 2 - 1)).chunk(2, 1)[0]
        return (mean - self.shift) * self.scale

    def decode(self, latents: Tensor) -> Tensor:
        out: Tensor = self.decoder(self.post_quant_conv(latents / self.scale + self.shift)) * 0.5 + 0.5
        return out.clamp(0, 1)


class _KLHalf(nn.Module):
    """Encoder: levels, then the middle. Decoder: the middle, then levels."""

    def __init__(self, inputs: int, outputs: int, widths: list[int], layers: int, groups: int, encoder: bool) -> None:
        super().__init__()
        self.is_encoder = encoder
        self.conv_in = nn.Conv2d(inputs, widths[0], 3, padding=1)
        levels, width = nn.ModuleList(), widths[0]
        for i, out in enumerate(widths):
            level = nn.Module()
            level.resnets = nn.ModuleList(
                ResnetBlock(width if j == 0 else out, out, None, groups, 1e-6) for j in range(layers)
            )
            if i < len(widths) - 1:
                name, resample = ("downsamplers", Downsample(out, True)) if encoder else ("upsamplers", Upsample(out))
                setattr(level, name, nn.ModuleList([resample]))
            levels.append(level)
            width = out
        setattr(self, "down_blocks" if encoder else "up_blocks", levels)
        middle = widths[-1] if encoder else widths[0]
        self.mid_block = _KLMiddle(middle, groups)
        self.conv_norm_out = nn.GroupNorm(groups, width, eps=1e-6)
        self.conv_out = nn.Conv2d(width, outputs, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        x = self.conv_in(x)
        if self.is_encoder:
            x = self.mid_block(self._levels(x, self.down_blocks, "downsamplers"))
        else:
            x = self._levels(self.mid_block(x), self.up_blocks, "upsamplers")
        out: Tensor = self.conv_out(F.silu(self.conv_norm_out(x)))
        return out

    @staticmethod
    def _levels(x: Tensor, levels: Any, resample: str) -> Tensor:
        for level in levels:
            for block in [*level.resnets, *getattr(level, resample, [])]:
                x = block(x)
        return x


class _KLMiddle(nn.Module):
    def __init__(self, channels: int, groups: int) -> None:
        super().__init__()
        self.resnets = nn.ModuleList(ResnetBlock(channels, channels, None, groups, 1e-6) for _ in range(2))
        self.attentions = nn.ModuleList([_KLAttention(channels, groups)])

    def forward(self, x: Tensor) -> Tensor:
        out: Tensor = self.resnets[1](self.attentions[0](self.resnets[0](x)))
        return out


class _KLAttention(nn.Module):
    """Single-head self-attention over space."""

    def __init__(self, channels: int, groups: int) -> None:
        super().__init__()
        self.group_norm = nn.GroupNorm(groups, channels, eps=1e-6)
        self.to_q, self.to_k, self.to_v = (nn.Linear(channels, channels) for _ in range(3))
        self.to_out = nn.ModuleList([nn.Linear(channels, channels)])

    def forward(self, x: Tensor) -> Tensor:
        tokens = self.group_norm(x).flatten(2).transpose(1, 2)
        attended = F.scaled_dot_product_attention(self.to_q(tokens), self.to_k(tokens), self.to_v(tokens))
        return x + self.to_out[0](attended).transpose(1, 2).reshape(x.shape)


def _modern_names(weights: dict[str, Tensor]) -> dict[str, Tensor]:
    """Old AutoencoderKL files call the attention's parts otherwise."""
    names = {".query.": ".to_q.", ".key.": ".to_k.", ".value.": ".to_v.", ".proj_attn.": ".to_out.0."}
    result = {}
    for name, value in weights.items():
        for old, new in names.items():
            name = name.replace(old, new)
        result[name] = value.flatten(1) if ".attentions." in name and value.dim() == 4 else value
    return result


class TinyAutoencoder(nn.Module):
    """TAESD and its relatives: the layers are read off the weights' names and shapes."""

    def __init__(self, encoder: dict[str, Tensor], decoder: dict[str, Tensor]) -> None:
        super().__init__()
        self.encoder = _tiny_layers(encoder, is_decoder=False)
        self.decoder = _tiny_layers(decoder, is_decoder=True)
        self.eval().requires_grad_(False)

    def encode(self, images: Tensor) -> Tensor:
        out: Tensor = self.encoder(images)
        return out

    def decode(self, latents: Tensor) -> Tensor:
        # TAESD softly limits its latents to +-3.
        out: Tensor = self.decoder(torch.tanh(latents / 3) * 3)
        return out.clamp(0, 1)


class _TinyBlock(nn.Module):
    def __init__(self, weights: dict[str, Tensor]) -> None:
        super().__init__()
        out, inside = weights["conv.0.weight"].shape[:2]
        self.conv = nn.Sequential(
            nn.Conv2d(inside, out, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(out, out, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(out, out, 3, padding=1),
        )
        self.skip = nn.Conv2d(inside, out, 1, bias=False) if "skip.weight" in weights else nn.Identity()
        if "pool.0.weight" in weights:  # a grouped norm over whole images in the middle blocks of newer models
            wide = weights["pool.0.weight"].shape[0]
            self.pool = nn.Sequential(
                nn.Conv2d(inside, wide, 1, bias=False),
                nn.GroupNorm(4, wide),
                nn.ReLU(),
                nn.Conv2d(wide, inside, 1, bias=False),
            )
        self.load_state_dict(weights)

    def forward(self, x: Tensor) -> Tensor:
        if hasattr(self, "pool"):
            x = x + self.pool(x)
        return F.relu(self.conv(x) + self.skip(x))


def _tiny_layers(weights: dict[str, Tensor], is_decoder: bool) -> nn.Sequential:
    """Indices without weights are the decoder's ReLU (after its first convolution) and then its upsamplings;
    convolutions without bias are the encoder's strided ones."""
    layers: list[nn.Module] = []
    indices = sorted({int(name.split(".")[0]) for name in weights})
    for index in range(indices[0], indices[-1] + 1):
        own = {k.split(".", 1)[1]: v for k, v in weights.items() if k.startswith(f"{index}.")}
        if not own:
            layers.append(nn.ReLU() if len(layers) == 1 else nn.Upsample(scale_factor=2))
        elif "weight" in own:
            out, inside = own["weight"].shape[:2]
            stride = 1 if is_decoder or "bias" in own else 2
            convolution = nn.Conv2d(inside, out, 3, stride, 1, bias="bias" in own)
            convolution.load_state_dict(own)
            layers.append(convolution)
        else:
            layers.append(_TinyBlock(own))
    return nn.Sequential(*layers)
