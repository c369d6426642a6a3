"""Sizes of the plane sweep's network."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class SweepConfig:
    """Sizes of `SweepNetwork`; the defaults are those of the shipped weights. Resolutions are shares of the image's."""

    #: Widths of the photo encoder at 1/2, 1/4, 1/8 and 1/16.
    encoder: tuple[int, int, int, int] = (24, 48, 96, 128)
    #: Channels that are matched at 1/4 and at 1/2.
    coarse_features: int = 24
    fine_features: int = 16
    #: Planes of a photo's own depth, from infinity to `nearest` (see `planes.photo_planes`).
    photo_planes: int = 32
    #: Largest inverse depth of a photo's planes, in the unit of the normalised scene.
    nearest: float = 10.0
    #: Other photos that a photo is matched with, at most.
    partners: int = 3
    #: Planes of a target, uniform in inverse depth.
    target_planes: int = 32
    #: Hypotheses that are left for the fine stage and for colours.
    hypotheses: int = 6
    #: By how much the scores of hypotheses, and of photos, are multiplied before colours are blended by them.
    sharpness: tuple[float, float] = (1.0, 1.0)
    #: Widths of the 3D U-Nets at 1/4, 1/8 and 1/16.
    volume: tuple[int, int, int] = (16, 32, 64)
    #: Widths of the finishing U-Net at full size, 1/2, 1/4 and 1/8.
    finish: tuple[int, int, int, int] = (16, 32, 64, 96)

    def to_json(self) -> str:
        """As one line of JSON."""
        return json.dumps(dataclasses.asdict(self))

    @staticmethod
    def from_json(text: str) -> SweepConfig:
        """What `to_json` wrote."""
        return SweepConfig.from_fields(json.loads(text))

    @staticmethod
    def from_fields(fields: dict[str, Any]) -> SweepConfig:
        """From JSON values. Raises TypeError for a field that there is not."""
        values: dict[str, Any] = {name: tuple(v) if isinstance(v, list) else v for name, v in fields.items()}
        return SweepConfig(**values)
