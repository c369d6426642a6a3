"""Splats behind the seam of all reconstructors."""

from __future__ import annotations

import dataclasses
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
from cat3d_core.splats import rasterize_cpu, rasterize_gsplat
from cat3d_core.splats.config import PRESETS, SplatConfig
from cat3d_core.splats.gaussians import Gaussians
from cat3d_core.splats.rasterize import render
from cat3d_core.splats.trainer import SplatTrainer, splats_of_state

GAUSSIAN_PIXELS = 10


class Splats(Trained[SplatTrainer]):
    """3D Gaussian splatting with MCMC densification, see `Reconstructor`."""

    presets: ClassVar[tuple[str, ...]] = tuple(PRESETS)

    def __init__(
        self,
        settings: Mapping[str, Any],
        request: ReconstructionRequest | None = None,
        gaussians: Gaussians | None = None,
    ) -> None:
        """Use `from_request` or `from_tensors`."""
        self.settings, self._request, self._gaussians = settings, request, gaussians

    @classmethod
    def from_request(cls, request: ReconstructionRequest) -> Self:
        config = chosen_config(request)
        perceptual = perceptual_name() if config.lpips_weight > 0 else None
        return cls({"splats": dataclasses.asdict(config), "perceptual": perceptual}, request)

    @classmethod
    def from_tensors(cls, settings: Mapping[str, Any], tensors: Mapping[str, Tensor], device: str) -> Self:
        _config(settings["splats"])
        return cls(settings, gaussians=Gaussians.from_tensors(tensors).to(device))

    @classmethod
    def from_state(cls, settings: Mapping[str, Any], state: Mapping[str, Tensor], device: str) -> Self:
        """As `from_tensors`, from the `state` of a training under way."""
        return cls.from_tensors(settings, splats_of_state(state), device)

    @property
    def view_pixels(self) -> int:
        """A Gaussian covers about GAUSSIAN_PIXELS of a view."""
        return GAUSSIAN_PIXELS * _config(self.settings["splats"]).most

    @property
    def gaussians(self) -> Gaussians:
        """The Gaussians as they are now, without gradient."""
        return (self._gaussians if self._gaussians is not None else self.trainer.gaussians).detach()

    def start(self, views: Views, seed: int, device: torch.device | str) -> list[Decision]:
        if self._request is None:
            raise ValueError("Finished splats are not trained further; make new ones from a request.")
        config, decisions = _fitted(_config(self.settings["splats"]), views)
        if torch.device(device).type == "cuda" and not rasterize_gsplat.available():
            decisions.append(
                Decision("warning", "Trained on the CPU: on CUDA splats need gsplat (pip install gsplat).")
            )
            device = "cpu"
        if torch.device(device).type == "cpu" and not rasterize_cpu.available():
            decisions.append(Decision("warning", "Rasterised in plain torch, over 10 times slower: there is no g++."))
        perceptual, warnings = perceptual_loss(config.lpips_weight, config.patch_size)
        self._trainer = SplatTrainer(config, views, seed, device, perceptual)
        return decisions + warnings

    def decisions(self) -> list[Decision]:
        trainer, out = self.trainer, []
        if trainer.config.lpips_every > 1 and trainer.perceptual is not None:
            text = f"The LPIPS loss was taken in one of {trainer.config.lpips_every} steps."
            out.append(Decision("skipped", text, "lpips"))
        if trainer.skipped:
            text = f"{trainer.skipped} steps with a non-finite loss or gradient were skipped."
            out.append(Decision("warning", text))
        return out

    def tensors(self) -> dict[str, Tensor]:
        return self.gaussians.tensors()

    def render(self, cameras: Cameras, index: int, scale: float = 1.0) -> Render:
        return render(self.gaussians, cameras, index, scale, _config(self.settings["splats"]).antialias)

    def uncertainty(self, cameras: Cameras, index: int) -> None:
        return None


_: type[Reconstructor] = Splats  # for the type checker: it keeps the protocol


def chosen_config(request: ReconstructionRequest) -> SplatConfig:
    """The preset with what the run skips and its overrides; without generated views there is no LPIPS loss.

    Raises ValueError naming a preset or setting that there isn't, or a bad value.
    """
    if request.preset not in PRESETS:
        raise ValueError(f"preset: {request.preset!r} is none of splats'; those are {', '.join(PRESETS)}.")
    config = PRESETS[request.preset]
    changes: dict[str, Any] = {"lpips_every": 2 if request.skip.get("lpips") else 1}
    if not request.generated:
        changes["lpips_weight"] = 0.0
    if request.overrides.get("most", config.most) < config.start:
        changes["start"] = request.overrides["most"]
    known = {f.name for f in dataclasses.fields(SplatConfig)}
    unknown = sorted(set(request.overrides) - known)
    if unknown:
        raise ValueError(f"overrides: {unknown[0]} is not a setting of splats; those are {', '.join(sorted(known))}.")
    try:
        return _config(dataclasses.asdict(config) | changes | dict(request.overrides))
    except (ValueError, TypeError) as error:
        raise ValueError(f"overrides: {error}") from None


def _config(document: Mapping[str, Any]) -> SplatConfig:
    """Settings from JSON or YAML, which know lists only. Raises ValueError for those of another version."""
    values: dict[str, Any] = {n: tuple(v) if isinstance(v, list) else v for n, v in document.items()}
    try:
        return SplatConfig(**values)
    except TypeError as error:
        raise ValueError(str(error)) from None


def _fitted(config: SplatConfig, views: Views) -> tuple[SplatConfig, list[Decision]]:
    """The settings where they depend on what there is to train on, and why."""
    if bool(views.captured.all()):
        return dataclasses.replace(config, lpips_weight=0.0), []
    smallest = min(config.window, int(views.size.min()))
    if config.lpips_weight == 0 or config.patch_size <= smallest:
        return config, []
    text = f"LPIPS patches are {smallest} pixels, the shorter side of the smallest view."
    return dataclasses.replace(config, patch_size=smallest), [Decision("chosen", text)]
