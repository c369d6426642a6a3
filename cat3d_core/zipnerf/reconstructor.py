"""Zip-NeRF behind the seam of all reconstructors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from cat3d_core.cameras import Cameras
from cat3d_core.decision import Decision
from cat3d_core.metrics.perceptual import perceptual_name
from cat3d_core.reconstruction.perceptual import perceptual_loss
from cat3d_core.reconstruction.protocol import ReconstructionRequest, Reconstructor
from cat3d_core.reconstruction.render import Render
from cat3d_core.reconstruction.trained import Trained
from cat3d_core.reconstruction.views import Views
from cat3d_core.zipnerf.config import PRESETS
from cat3d_core.zipnerf.field import Field
from cat3d_core.zipnerf.render import render_image, render_uncertainty
from cat3d_core.zipnerf.settings import chosen_config, config_document, config_from_document, fitted, rules
from cat3d_core.zipnerf.trainer import Trainer

#: About so many photos show the whole scene once.
PASSED = 8


class ZipNerf(Trained[Trainer]):
    """Robust Zip-NeRF (CAT3D sec. 'Robust 3D reconstruction'), see `Reconstructor`."""

    presets: ClassVar[tuple[str, ...]] = tuple(PRESETS)

    def __init__(
        self, settings: Mapping[str, Any], request: ReconstructionRequest | None = None, field: Field | None = None
    ) -> None:
        """Use `from_request` or `from_tensors`."""
        self.settings, self._request, self._field = settings, request, field

    @classmethod
    def from_request(cls, request: ReconstructionRequest) -> Self:
        config = chosen_config(request)
        perceptual = perceptual_name() if config.lpips_weight > 0 else None
        settings = {"trainer": config_document(config), "perceptual": perceptual, **rules(request.skip)}
        return cls(settings, request)

    @classmethod
    def from_tensors(cls, settings: Mapping[str, Any], tensors: Mapping[str, Tensor], device: str) -> Self:
        field = Field.from_state(config_from_document(settings["trainer"]), tensors)
        return cls(settings, field=field.to(device).eval())

    @classmethod
    def from_state(cls, settings: Mapping[str, Any], state: Mapping[str, Tensor], device: str) -> Self:
        """As `from_tensors`, from the `state` of a training under way."""
        own = {name.removeprefix("field."): v for name, v in state.items() if name.startswith("field.")}
        return cls.from_tensors(settings, own, device)

    @property
    def view_pixels(self) -> int:
        """So many that the training sees each pixel of PASSED views once: what is more stays blurred."""
        config = config_from_document(self.settings["trainer"])
        return config.iterations * config.batch_rays // PASSED

    @property
    def field(self) -> Field:
        """The field as it is now."""
        return self._field if self._field is not None else self.trainer.field

    def start(self, views: Views, seed: int, device: torch.device | str) -> list[Decision]:
        if self._request is None:
            raise ValueError("A finished field is not trained further; make a new one from a request.")
        config = config_from_document(self.settings["trainer"])
        config, decisions = fitted(config, views, self._request.skip, self._request.overrides)
        perceptual, warnings = perceptual_loss(config.lpips_weight, config.patch_size)
        self._trainer = Trainer(config, views, seed, device, perceptual)
        return decisions + warnings

    def step(self) -> dict[str, float]:
        return super().step() | {"rays": float(self.trainer.config.batch_rays)}

    def decisions(self) -> list[Decision]:
        return _skipped(self.trainer)

    def tensors(self) -> dict[str, Tensor]:
        return {name: value.detach() for name, value in self.field.state_dict().items()}

    def render(self, cameras: Cameras, index: int, scale: float = 1.0) -> Render:
        return render_image(self.field, cameras.to(dtype=torch.float32), index, resolution_scale=scale)

    def uncertainty(self, cameras: Cameras, index: int) -> Tensor:
        return render_uncertainty(self.field, cameras.to(dtype=torch.float32), index)


_: type[Reconstructor] = ZipNerf  # for the type checker: it keeps the protocol


def _left_out(first: int, end: int, every: int) -> int:
    """How many of the steps from `first` on, below `end`, are no multiple of `every`."""
    return sum(step % every != 0 for step in range(first, end))


def _skipped(trainer: Trainer) -> list[Decision]:
    """What the training did without."""
    config, steps, out = trainer.config, trainer.iteration, []

    def skipped(switch: str, text: str, **saved: float) -> None:
        out.append(Decision("skipped", text, switch, saved))

    if config.low_resolution_iterations:
        half = min(steps, config.low_resolution_iterations)
        skipped("low_resolution", f"Images of half the size in {half} of {steps} steps.", steps_at_full_size=half)
    if config.proposal_every > 1:
        text = f"Proposals were trained at every {config.proposal_every}th step after the warm-up."
        skipped("proposals", text, proposal_steps=_left_out(config.warmup_iterations, steps, config.proposal_every))
    if config.lpips_every > 1 and trainer.perceptual is not None:
        text = f"The LPIPS loss was taken in one of {config.lpips_every} steps."
        skipped("lpips", text, lpips_steps=_left_out(config.low_resolution_iterations, steps, config.lpips_every))
    if config.skip_transmittance:
        share = f"{config.skip_transmittance:g}"
        skipped("empty_space", f"The field was not asked where less than {share} of a ray's light is left.")
    if steps < config.iterations:
        left = config.iterations - steps
        text = (
            f"Skipped {left} of {config.iterations} steps: from step {trainer.plateau_at} on "
            "held-out pixels no longer improved, and a cool-down ended the training."
        )
        skipped("plateau", text, steps=float(left))
    if trainer.skipped:
        text = f"{trainer.skipped} steps with a non-finite loss or gradient were skipped."
        out.append(Decision("warning", text))
    return out
