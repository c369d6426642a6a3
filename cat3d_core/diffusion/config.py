"""What a multi-view latent diffusion model is: typed, immutable, and the same after a JSON round trip."""

from __future__ import annotations

import dataclasses
import json
import types
import typing
from dataclasses import dataclass, field
from typing import Any, Literal

ViewAttention = Literal["3d", "temporal", "none"]
CameraInput = Literal["raymap", "vector"]
Prediction = Literal["v", "eps"]

#: Maps of what is known of a target beside its colour: share that lies inside some photo, how far the colour is right,
#: inverse depth, its spread (see hints.py).
HINT_MAPS = ("seen", "confidence", "inverse_depth", "spread")


@dataclass(frozen=True)
class AutoencoderConfig:
    """Image <-> latent, 8 times smaller on each side. `widths` are the channels at 1/2, 1/4 and 1/8 size, `blocks` the
    residual blocks there (the decoder has one more at each size). `linear`: a linear transform of 8 x 8 blocks beside
    both networks, which then only correct it."""

    latent_channels: int = 8
    widths: tuple[int, int, int] = (48, 96, 160)
    blocks: tuple[int, int, int] = (1, 2, 2)
    norm_groups: int = 8
    linear: bool = False


@dataclass(frozen=True)
class UNetConfig:
    """The denoising network: a Stable-Diffusion-like U-Net whose self-attention sees all views of a group.

    latent_size: side of the latents it was made for; level i works at latent_size / 2**i.
    attention: which levels have self-attention (the middle always has); heads: attention heads of each level.
    view_attention: "3d" joins the views' tokens in the self-attention of levels not larger than `max_3d_size`
    (paper: 32); "temporal" adds a 1D attention over views at each place instead; "none" is the 2D network.
    decoder_only: views meet in the middle and the up path only.
    camera: "raymap" concatenates 6 ray channels; "vector" feeds 8 numbers per view through cross-attention.
    ray_octaves: sines and cosines of the ray channels at this many octaves are concatenated too (0: the rays alone).
    relative_cameras: 3D attention carries its vectors from camera to camera (attention.ViewFrames): not in the paper,
    and without weights of its own.
    hints: further input channels for what is known of targets beforehand (hints.py): not in the paper.
    """

    latent_channels: int = 8
    latent_size: int = 64
    channels: tuple[int, ...] = (320, 640, 1280, 1280)
    blocks: int = 2
    attention: tuple[bool, ...] = (True, True, True, False)
    heads: tuple[int, ...] = (5, 10, 20, 20)
    linear_projection: bool = True
    norm_groups: int = 32
    view_attention: ViewAttention = "3d"
    max_3d_size: int = 32
    decoder_only: bool = False
    camera: CameraInput = "raymap"
    cross_attention_dim: int = 1024
    ray_octaves: int = 0
    relative_cameras: bool = False
    hints: bool = False

    def __post_init__(self) -> None:
        levels = len(self.channels)
        if len(self.attention) != levels or len(self.heads) != levels:
            raise ValueError(
                f"The U-Net has {levels} levels of channels, so attention and heads need {levels} entries."
            )
        for channels, heads in zip(self.channels, self.heads, strict=True):
            if channels % self.norm_groups or channels % heads:
                raise ValueError(
                    f"{channels} channels can't be split into {self.norm_groups} norm groups and {heads} heads."
                )
            if self.relative_cameras and channels // heads % 8:
                raise ValueError(
                    f"relative_cameras needs heads of a multiple of 8 channels; {channels} channels on {heads} heads "
                    f"are {channels // heads} each."
                )

    @property
    def input_channels(self) -> int:
        """Latent, mask, (unless the camera enters as a vector) raymap and hint channels."""
        rays = 6 * (1 + 2 * self.ray_octaves) if self.camera == "raymap" else 0
        return self.latent_channels + 1 + rays + self.hint_channels

    @property
    def hint_channels(self) -> int:
        """The last of the input channels: latents of the warped picture and the maps of HINT_MAPS, or none."""
        return self.latent_channels + len(HINT_MAPS) if self.hints else 0

    def level_attention(self, level: int, decoder: bool) -> ViewAttention:
        """How views meet at this level."""
        if self.latent_size >> level > self.max_3d_size or (self.decoder_only and not decoder):
            return "none"
        return self.view_attention


@dataclass(frozen=True)
class ScheduleConfig:
    """Noise. The log-SNR of `base` is lowered by log(number of targets) when `shift` is set (paper, section 3.1).

    time_input: the time that the network is given: "noise" = the step of the unshifted table that has the same log-SNR
    (what a pretrained network knows), "index" = the step itself.
    """

    base: Literal["scaled_linear", "linear", "cosine"] = "scaled_linear"
    steps: int = 1000
    beta_start: float = 0.00085
    beta_end: float = 0.012
    zero_terminal_snr: bool = True
    shift: bool = True
    prediction: Prediction = "v"
    time_input: Literal["noise", "index"] = "noise"

    def __post_init__(self) -> None:
        if self.prediction == "eps" and self.zero_terminal_snr:
            raise ValueError(
                "eps-prediction can't be used with zero terminal SNR: at the last step the input is pure noise, so the "
                "clean latent (x - sigma eps) / alpha is 0 / 0. Use prediction='v' or zero_terminal_snr=False."
            )


@dataclass(frozen=True)
class ModelConfig:
    """The whole model. `views` = conditioning + target views in one group, fixed in training (paper: 8)."""

    unet: UNetConfig = field(default_factory=UNetConfig)
    autoencoder: AutoencoderConfig = field(default_factory=AutoencoderConfig)
    schedule: ScheduleConfig = field(default_factory=ScheduleConfig)
    views: int = 8

    def __post_init__(self) -> None:
        if self.unet.latent_channels != self.autoencoder.latent_channels:
            raise ValueError(
                f"The U-Net works on {self.unet.latent_channels} latent channels, the autoencoder makes "
                f"{self.autoencoder.latent_channels}; they have to agree."
            )
        if self.views < 2:
            raise ValueError(f"A group needs a conditioning and a target view; views is {self.views}.")

    @property
    def image_size(self) -> int:
        """Side in pixels of the square images it was made for."""
        return self.unet.latent_size * 8

    def to_json(self) -> str:
        return json.dumps(dataclasses.asdict(self), sort_keys=True)

    @classmethod
    def from_json(cls, text: str) -> ModelConfig:
        """Raises ValueError for unknown or wrongly typed fields."""
        return from_dict(cls, json.loads(text))


def from_dict(cls: Any, values: dict[str, Any]) -> Any:
    """A (nested) dataclass from plain JSON values: lists become tuples, sub-objects their dataclasses."""
    hints = typing.get_type_hints(cls)
    unknown = sorted(set(values) - set(hints))
    if unknown:
        raise ValueError(f"{cls.__name__} has no field {', '.join(unknown)}; it has {', '.join(sorted(hints))}.")
    return cls(**{name: _convert(f"{cls.__name__}.{name}", hints[name], value) for name, value in values.items()})


def _convert(name: str, hint: Any, value: Any) -> Any:
    if dataclasses.is_dataclass(hint):
        return from_dict(hint, value)
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is tuple and isinstance(value, (list, tuple)):
        return tuple(_convert(name, arguments[0], v) for v in value)
    if origin in (typing.Union, types.UnionType):
        if value is None and type(None) in arguments:
            return None
        return _convert(name, next(a for a in arguments if a is not type(None)), value)
    if origin is Literal and value in arguments:
        return value
    if hint is float and isinstance(value, (int, float)) and not isinstance(value, bool):
        return float(value)
    if isinstance(hint, type) and origin is None and type(value) is hint:
        return value
    raise ValueError(f"{name} can't be {value!r}: {hint} is expected.")


# tiny: tests. small: the shipped model, trained at 64 pixels (8x8 latents) first, 3D attention at every level.
# paper: 512 pixels, 64x64x8 latents; the layout of Stable Diffusion 2 with the text cross-attention gone.
SIZES: dict[str, ModelConfig] = {
    "tiny": ModelConfig(
        UNetConfig(
            latent_size=8,
            channels=(32, 64),
            blocks=1,
            attention=(True, True),
            heads=(1, 2),
            norm_groups=8,
            max_3d_size=8,
            cross_attention_dim=32,
        ),
        AutoencoderConfig(widths=(16, 24, 32), blocks=(1, 1, 1)),
        ScheduleConfig(base="cosine"),
    ),
    "small": ModelConfig(
        UNetConfig(
            latent_size=8,
            channels=(96, 192),
            blocks=1,
            attention=(True, True),
            heads=(2, 3),
            max_3d_size=64,
            cross_attention_dim=192,
        ),
        AutoencoderConfig(widths=(32, 64, 128), blocks=(1, 1, 1), linear=True),
        ScheduleConfig(base="cosine"),
    ),
    "paper": ModelConfig(UNetConfig(), AutoencoderConfig(widths=(128, 256, 512), blocks=(2, 2, 2), norm_groups=32)),
}
