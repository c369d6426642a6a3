"""What `cat3d train` is asked for, and the table that a training leaves behind."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal, Self

import pyarrow as pa
from pydantic import Field, FiniteFloat, NonNegativeInt, PositiveFloat, PositiveInt, model_validator

from schemas.config import _Model

Share = Annotated[FiniteFloat, Field(ge=0, lt=1)]
Family = Literal["llff", "dtu", "co3d", "re10k", "mip360"]


class ModelChoice(_Model):
    """The network: one of the built-in sizes, with fields replaced."""

    size: Literal["tiny", "small", "paper"] = "small"
    """Built-in size that the rest starts from."""
    image_size: Annotated[int, Field(ge=16, multiple_of=8)] | None = None
    """Side of the square images in pixels; None: the size's own. Latents have an eighth of it."""
    views: Annotated[int, Field(ge=2)] = 8
    """Conditioning and target views of a group together (paper: 8)."""
    unet: dict[str, Any] = Field(default_factory=dict)
    """Fields of the core's UNetConfig to replace: the paper's ablations (view_attention, camera, max_3d_size, …)."""
    autoencoder: dict[str, Any] = Field(default_factory=dict)
    """Fields of AutoencoderConfig to replace."""
    schedule: dict[str, Any] = Field(default_factory=dict)
    """Fields of ScheduleConfig to replace, such as {shift: false}."""


class SceneBankConfig(_Model):
    """Procedural scenes, rendered and encoded once."""

    families: Annotated[tuple[Family, ...], Field(min_length=1)] = ("llff", "dtu", "co3d", "re10k", "mip360")
    """Families of scenes; each is drawn equally often (paper, appendix A)."""
    scenes: PositiveInt = 1250
    """Scenes rendered, shared out evenly over the families."""
    views: Annotated[int, Field(ge=2)] = 16
    """Cameras of a scene; a group is drawn from them."""
    variants: Annotated[int, Field(ge=1, le=3)] = 3
    """1: as rendered; 2: also recoloured and mirrored; 3: also recoloured."""
    worlds: Path | None = None
    """Folder into which Debian's supertuxkart-data was unpacked (`cat3d worlds`): textured worlds beside the
    procedural scenes, each of their five kinds of camera paths a family of its own."""
    world_groups: PositiveInt = 600
    """Captures of these worlds, if there are any."""
    others: tuple[Path, ...] = ()
    """With hints: folders of more scenes (renders/*.safetensors), such as the bank of a training of the sweep, whose
    first shard is left out here as it is there."""
    sweep: Path | None = None
    """With hints: the plane sweep that predicts them; None: the one shipped."""
    textures: Path | None = None
    """Folder of photographs (.jpg) to cut textures from, beside the procedural ones."""
    folder: Path | None = None
    """Where scenes, autoencoder and latents are kept; None: with the model. Several trainings may share one."""
    seed: Annotated[int, Field(ge=0, lt=2**63)] | None = None
    """What scenes and autoencoder are drawn from; None: the training's. Trainings of several seeds can share one."""
    max_gib: PositiveFloat = 8.0
    """Refuse a bank that takes more disk than this, in GiB (renders and latents)."""


class AutoencoderTraining(_Model):
    """Where images become latents. Order: `path`, else the shipped model's if it is this network, else trained."""

    path: Path | None = None
    """A model file, or the autoencoder.safetensors of an earlier training."""
    shipped: bool = True
    """Take the shipped model's autoencoder where it fits."""
    minutes: PositiveFloat = 15.0
    """Training time, if it has to be trained."""
    batch: PositiveInt = 16
    """Images of a step: renders, and windows of the photographs where there are any."""
    learning_rate: PositiveFloat = 2.5e-3
    """Highest learning rate; it rises for 60 steps and falls to zero over the time."""


class OptimizerConfig(_Model):
    """AdamW and what is around it (paper, appendix A: 5e-5 at batch 128, conditioning dropped in 10 %)."""

    learning_rate: PositiveFloat = 5e-5
    """After warm-up."""
    final_learning_rate: PositiveFloat | None = None
    """At the end of a half cosine; None: constant."""
    warmup_steps: NonNegativeInt = 100
    groups: PositiveInt = 4
    """Groups in one evaluation, on each device."""
    accumulate: PositiveInt = 1
    """Evaluations of one optimizer step."""
    drop_probability: Share = 0.1
    """Share of groups without conditioning, for guidance."""
    drop: Literal["images_and_poses", "images"] = "images_and_poses"
    """What such groups do without (paper: both)."""
    weight_decay: Annotated[FiniteFloat, Field(ge=0)] = 0.01
    hint_weight: Annotated[FiniteFloat, Field(ge=0, le=1)] = 0.25
    """With hints: weight of the loss where a hint is wholly certain; there the finished view shows the hint."""
    clip_norm: PositiveFloat = 1.0
    ema_decay: Share = 0.9995
    min_snr_gamma: PositiveFloat | None = None
    """Loss weights of Hang et al. 2023; None: uniform."""
    precision: Literal["float32", "bfloat16"] = "bfloat16"
    """Of the network; the weights that are updated are float32."""


class TrainRunConfig(_Model):
    """One training of a multi-view diffusion model."""

    name: str = "training"
    note: str = ""
    """What it is for, in a sentence."""
    model: ModelChoice = Field(default_factory=ModelChoice)
    bank: SceneBankConfig = Field(default_factory=SceneBankConfig)
    autoencoder: AutoencoderTraining = Field(default_factory=AutoencoderTraining)
    optimizer: OptimizerConfig = Field(default_factory=OptimizerConfig)
    conditions: Annotated[tuple[PositiveInt, ...], Field(min_length=1)] = (1, 3)
    """Numbers of conditioning views, taken in turn: (1, 3) of 8 views are the paper's joint modes 1+7 and 3+5."""
    joint_from: Share = 0.0
    """Before this share of the training only the first of `conditions` is used (paper: 1 M of 1.4 M steps)."""
    steps: PositiveInt | None = None
    """Optimizer steps. A training by steps is the same to the bit if it is stopped and resumed (on one device)."""
    minutes: PositiveFloat | None = None
    """Instead of steps: time spent in training; learning rate and spread follow the time."""
    spread: tuple[Annotated[float, Field(gt=0, le=1)], Annotated[float, Field(gt=0, le=1)]] = (0.5, 1.0)
    """Share of a scene's cameras, nearest first, that a group is drawn from: at the start, and after 70 % of the
    training."""
    scale_jitter: Annotated[FiniteFloat, Field(ge=1)] = 1.4
    """Ray origins are scaled by a random number from 1 / this to this: when the model is used, a scene's unit is only
    roughly known."""
    start: Path | None = None
    """Weights to start from: a model file of ours, or Stable Diffusion's U-Net (diffusers folder, or safetensors)."""
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 0
    """All randomness follows from it."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    log_steps: PositiveInt = 10
    """Optimizer steps of a row in the table."""
    save_minutes: PositiveFloat = 4.0
    """Between checkpoints."""
    sample_minutes: PositiveFloat = 20.0
    """Between sample sheets; the last is made at the end."""
    sample_scenes: PositiveInt = 1
    """Held-out scenes of each family on a sheet."""
    sample_steps: Annotated[int, Field(ge=1)] = 20
    """Sampler steps of a sheet."""

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if (self.steps is None) == (self.minutes is None):
            raise ValueError("a training ends after a number of steps or after minutes: give one of the two")
        if max(self.conditions) >= self.model.views:
            raise ValueError(
                f"conditions go up to {max(self.conditions)}, which leaves no target in a group of "
                f"{self.model.views} views"
            )
        if self.bank.views < self.model.views:
            raise ValueError(
                f"a scene of the bank has {self.bank.views} views, fewer than the {self.model.views} of a group"
            )
        if self.bank.scenes < len(self.bank.families):
            raise ValueError(f"{self.bank.scenes} scenes are fewer than the {len(self.bank.families)} families")
        return self


def _column(name: str, kind: pa.DataType, meaning: str, unit: str = "") -> pa.Field:
    return pa.field(name, kind, metadata={"meaning": meaning, "unit": unit})


TRAINING = pa.schema(
    [
        _column("step", pa.int64(), "optimizer steps made so far"),
        _column("groups", pa.int64(), "groups of views seen so far, on all devices"),
        _column("seconds", pa.float64(), "time spent in training so far", "s"),
        _column("loss", pa.float64(), "mean loss since the row before, on rank 0"),
        _column("learning_rate", pa.float64(), "of the last step"),
        _column("gradient_norm", pa.float64(), "of the last step, before clipping"),
        _column("spread", pa.float64(), "share of a scene's cameras drawn from"),
        _column("groups_per_s", pa.float64(), "throughput since the row before, on all devices", "1/s"),
        _column("ranks", pa.int32(), "devices that shared the work"),
        _column("device", pa.string(), "cpu, or the name of the accelerator"),
    ],
    metadata={"format": "cat3d-training", "schema_version": "1", "row": "some optimizer steps of a training"},
)

SAMPLES = pa.schema(
    [
        _column("step", pa.int64(), "optimizer steps of the sampled weights"),
        _column("family", pa.string(), "family of held-out scenes"),
        _column("condition_views", pa.int32(), "given views"),
        _column("psnr_right_db", pa.float64(), "sample against the exact view from its own camera", "dB"),
        _column("psnr_wrong_db", pa.float64(), "sample against the other targets' views, mean", "dB"),
        _column("psnr_nearest_db", pa.float64(), "nearest given view, copied, against the exact view", "dB"),
        _column("matched", pa.float64(), "share of samples nearer to their own view than to any other target's"),
    ],
    metadata={"format": "cat3d-training-samples", "schema_version": "1", "row": "held-out scenes of a family"},
)
