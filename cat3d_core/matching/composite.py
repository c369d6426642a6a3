"""Photos where they show it, the diffusion model's sample elsewhere."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Composite:
    """The share of the warped colour at a confidence c: sigmoid((c - middle) / softness)."""

    middle: float = 0.35
    softness: float = 0.15

    def share(self, confidence: Tensor) -> Tensor:
        """Of a confidence in [0, 1], any shape."""
        return torch.sigmoid((confidence - self.middle) / self.softness)

    def __call__(self, colour: Tensor, confidence: Tensor, sample: Tensor) -> Tensor:
        """colour and sample (N, 3, H, W), confidence (N, H, W) -> (N, 3, H, W)."""
        return sample + self.share(confidence)[:, None] * (colour - sample)

    def to_json(self) -> str:
        """As one line of JSON."""
        return json.dumps(dataclasses.asdict(self))

    @staticmethod
    def from_json(text: str) -> Composite:
        """What `to_json` wrote."""
        return Composite(**json.loads(text))
