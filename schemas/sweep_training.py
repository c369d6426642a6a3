"""What `cat3d train sweep` is asked for, and the tables that it leaves behind."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal, Self

import pyarrow as pa
from pydantic import BaseModel, Field, FiniteFloat, NonNegativeInt, PositiveFloat, PositiveInt, model_validator

from schemas.config import _Model
from schemas.training import Family, Share, _column


class Kind(BaseModel):
    """The one field of a training's file that says which configuration it is."""

    kind: Literal["multiview", "sweep"] = "multiview"


class GeometryBankConfig(_Model):
    """Scenes with exact depth: procedural ones and worlds, rendered once, and folders of others."""

    families: Annotated[tuple[Family, ...], Field(min_length=1)] = ("llff", "dtu", "co3d", "re10k", "mip360")
    """Families of procedural scenes, in turn."""
    scenes: PositiveInt = 2000
    """Procedural scenes."""
    worlds: Path | None = None
    """Folder into which Debian's supertuxkart-data was unpacked (`cat3d worlds`); as often drawn as all procedural
    scenes together."""
    world_groups: PositiveInt = 600
    """Captures of these worlds, if there are any."""
    views: Annotated[int, Field(ge=2)] = 10
    """Cameras of a scene; photos and targets are drawn from them."""
    size: Annotated[int, Field(ge=16, multiple_of=16)] = 128
    """Side of the stored images in pixels; stages may use it or a whole part of it."""
    textures: Path | None = None
    """Folder of photographs (.jpg) to cut textures from, beside the procedural ones."""
    folder: Path | None = None
    """Where the rendered scenes are kept; None: with the weights."""
    others: tuple[Path, ...] = ()
    """Folders of more scenes in the same format (renders/*.safetensors); all folders are drawn equally often."""
    seed: Annotated[int, Field(ge=0, lt=2**63)] | None = None
    """What the procedural scenes are drawn from; None: the training's."""
    held: PositiveInt = 1
    """First shards of each folder that are kept for validation."""


class SweepStage(_Model):
    """A part of the training."""

    size: Annotated[int, Field(ge=16, multiple_of=16)] = 128
    """Side of the images in pixels."""
    share: Annotated[FiniteFloat, Field(gt=0, le=1)] = 1.0
    """Of the whole training."""
    scenes: PositiveInt = 1
    """Scenes of a step, with up to three photos; fewer with more."""
    targets: PositiveInt = 3
    """Targets of a scene; fewer where its views don't suffice."""


class SweepRunConfig(_Model):
    """One training of the plane sweep."""

    kind: Literal["sweep"] = "sweep"
    name: str = "sweep"
    note: str = ""
    """What it is for, in a sentence."""
    network: dict[str, Any] = Field(default_factory=dict)
    """Fields of the core's SweepConfig to replace."""
    bank: GeometryBankConfig = Field(default_factory=GeometryBankConfig)
    stages: Annotated[tuple[SweepStage, ...], Field(min_length=1)] = (
        SweepStage(size=64, share=0.35, scenes=2), SweepStage(size=128, share=0.65),
    )  # fmt: skip
    """One after the other; their shares add up to 1."""
    photos: Annotated[tuple[Annotated[FiniteFloat, Field(ge=0)], ...], Field(min_length=1)] = (
        0.25, 0.13, 0.42, 0.08, 0.03, 0.03, 0.02, 0.02, 0.02,
    )  # fmt: skip
    """How often a step has 1, 2, 3 ... photos."""
    learning_rate: PositiveFloat = 1e-3
    """After warm-up; it falls to the final one over the training, along half a cosine."""
    final_learning_rate: PositiveFloat = 3e-5
    warmup_steps: NonNegativeInt = 100
    """Also after each change of stage and each start from given weights."""
    weight_decay: Annotated[FiniteFloat, Field(ge=0)] = 0.01
    clip_norm: PositiveFloat = 1.0
    ema_decay: Share = 0.998
    precision: Literal["float32", "bfloat16"] = "bfloat16"
    steps: PositiveInt | None = None
    """Optimizer steps. A training by steps is the same to the bit if it is stopped and resumed on one bank."""
    minutes: PositiveFloat | None = None
    """Instead of steps: time spent in training."""
    spread: tuple[Annotated[float, Field(gt=0, le=1)], Annotated[float, Field(gt=0, le=1)]] = (0.5, 1.0)
    """Share of a scene's cameras, nearest first, that a step draws from: at the start, and after 70 % of the
    training."""
    start: Path | None = None
    """Weights to start from: a file that a training of the sweep left."""
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 0
    device: Literal["auto", "cpu", "cuda"] = "auto"
    log_steps: PositiveInt = 20
    """Optimizer steps of a row in the table."""
    save_minutes: PositiveFloat = 3.0
    """Between checkpoints; scenes that have appeared in the folders since are read then."""
    validate_minutes: PositiveFloat = 12.0
    """Between validations on the held shards."""

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if (self.steps is None) == (self.minutes is None):
            raise ValueError("a training ends after a number of steps or after minutes: give one of the two")
        if abs(sum(stage.share for stage in self.stages) - 1) > 1e-6:
            raise ValueError(f"the stages' shares add up to {sum(s.share for s in self.stages):g}; they should to 1")
        for stage in self.stages:
            if self.bank.size % stage.size:
                raise ValueError(f"a stage of {stage.size} pixels does not divide the bank's {self.bank.size}")
        if sum(self.photos) <= 0:
            raise ValueError("photos: at least one number of photos needs a share above 0")
        if len(self.photos) >= self.bank.views:
            raise ValueError(f"{len(self.photos)} photos leave no target among a scene's {self.bank.views} views")
        return self


SWEEP_TRAINING = pa.schema(
    [
        _column("step", pa.int64(), "optimizer steps made so far"),
        _column("seconds", pa.float64(), "time spent in training so far", "s"),
        _column("size", pa.int32(), "side of the images", "pixel"),
        _column("scenes", pa.int64(), "scenes in the bank"),
        _column("loss", pa.float64(), "weighted sum of the terms, mean since the row before"),
        _column("colour", pa.float64(), "error of the finished colour, mean since the row before"),
        _column("depth", pa.float64(), "expected error of inverse depth as a share of the nearest plane's"),
        _column("sure", pa.float64(), "cross-entropy of the confidence"),
        _column("learning_rate", pa.float64(), "of the last step"),
        _column("gradient_norm", pa.float64(), "of the last step, before clipping"),
        _column("targets_per_s", pa.float64(), "throughput since the row before", "1/s"),
        _column("device", pa.string(), "cpu, or the name of the accelerator"),
    ],
    metadata={"format": "cat3d-sweep-training", "schema_version": "1", "row": "some optimizer steps of a training"},
)

SWEEP_VALIDATION = pa.schema(
    [
        _column("step", pa.int64(), "optimizer steps of the averaged weights"),
        _column("source", pa.string(), "folder of the scenes"),
        _column("photos", pa.int32(), "given views"),
        _column("size", pa.int32(), "side of the images", "pixel"),
        _column("psnr_db", pa.float64(), "finished colour against the exact view", "dB"),
    ],
    metadata={"format": "cat3d-sweep-validation", "schema_version": "1", "row": "held scenes of a folder"},
)
