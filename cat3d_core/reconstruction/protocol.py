"""The seam between the pipeline and a way of reconstructing a scene: what it is asked, and what it answers.

A reconstructor is one class with the members of `Reconstructor`; it is chosen by name (`reconstruct.method`). The
pipeline makes one with `from_request`, starts it on the training views, steps it until it is finished, and stores its
`settings` and `tensors`; from those `from_tensors` makes it again, to render.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Protocol, Self, runtime_checkable

import torch
from torch import Tensor

from cat3d_core.cameras import Cameras
from cat3d_core.decision import Decision
from cat3d_core.reconstruction.render import Render
from cat3d_core.reconstruction.views import Views


class NonFiniteError(ValueError):
    """Training met more steps that were not finite than its settings allow; the message names the views and pixels of
    the last one."""


@dataclass(frozen=True)
class ReconstructionRequest:
    """What is asked of a reconstruction, as far as it is known before anything runs.

    preset: name of a set of settings; overrides: those that the user gives. dataset: the scene's family (co3d, llff,
    ...), where a paper's settings depend on it. generated: whether views are generated. skip: the switches of the
    configuration's section `skip`; one that is missing is off.
    """

    preset: str
    overrides: Mapping[str, Any] = field(default_factory=dict)
    dataset: str = ""
    generated: bool = False
    skip: Mapping[str, bool] = field(default_factory=dict)


@runtime_checkable
class Reconstructor(Protocol):
    """A way to turn posed views into something that renders. Lengths are in units of the normalised scene."""

    #: Names of the presets, the quickest first; that one makes the brief reconstructions by which views are chosen. One
    #: is "fast", which is asked for where the user names none.
    presets: ClassVar[tuple[str, ...]]
    #: Everything that can change the result, as JSON values: part of the stage's content key, and stored beside the
    #: tensors.
    settings: Mapping[str, Any]
    # One that has `view_pixels: int` says by it how many pixels of a view its training can fill; photos that have far
    # more are made smaller before (docs/guides/own_reconstructor.md).

    @classmethod
    def from_request(cls, request: ReconstructionRequest) -> Self:
        """One that can be started. Raises ValueError naming a preset or setting that it does not have."""
        ...

    @classmethod
    def from_tensors(cls, settings: Mapping[str, Any], tensors: Mapping[str, Tensor], device: str) -> Self:
        """One that can render, from what `settings` and `tensors` once were. Raises ValueError where they do not
        fit."""
        ...

    def start(self, views: Views, seed: int, device: torch.device | str) -> list[Decision]:
        """Take the training views; the seed is all that randomness comes from. What depends on what there is to train
        on is settled now; what was decided is returned. Raises ValueError for views that cannot be used."""
        ...

    @property
    def iteration(self) -> int:
        """Steps made so far."""
        ...

    @property
    def iterations(self) -> int:
        """Steps that are planned; it may be finished before."""
        ...

    @property
    def finished(self) -> bool:
        """Whether no further step is to be made."""
        ...

    def step(self) -> dict[str, float]:
        """One iteration; numbers on it, of which "loss", "psnr" (dB) and "rays" (cast) are recorded where they are
        given. Raises NonFiniteError where training broke down."""
        ...

    def state(self) -> dict[str, Tensor]:
        """Everything an exact continuation needs, flat, on the CPU."""
        ...

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Go on, once started, from a `state`. Raises ValueError where it does not fit."""
        ...

    def decisions(self) -> list[Decision]:
        """What was decided in the steps so far: what they did without, what went wrong."""
        ...

    def tensors(self) -> dict[str, Tensor]:
        """The result, on any device: all that rendering needs beside the settings."""
        ...

    def render(self, cameras: Cameras, index: int, scale: float = 1.0) -> Render:
        """What camera `index` sees, at `scale` times its size; tensors on any device."""
        ...

    def uncertainty(self, cameras: Cameras, index: int) -> Tensor | None:
        """(H, W) in [0, 1]: how uncertain the place is that each pixel of camera `index` shows; None where the method
        cannot tell."""
        ...
