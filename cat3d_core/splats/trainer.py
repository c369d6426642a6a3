"""Training of splats from posed views, deterministic and resumable."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from cat3d_core.metrics.ssim import ssim_map
from cat3d_core.random import derive_seed
from cat3d_core.reconstruction.protocol import NonFiniteError
from cat3d_core.reconstruction.views import Views, draw_views
from cat3d_core.splats.config import SplatConfig
from cat3d_core.splats.density import noise, relocate
from cat3d_core.splats.gaussians import Gaussians
from cat3d_core.splats.rasterize import Window, rasterize
from cat3d_core.splats.start import start
from cat3d_core.zipnerf import losses
from cat3d_core.zipnerf.adam import Adam
from cat3d_core.zipnerf.coordinates import contract

Perceptual = Callable[[Tensor, Tensor], Tensor]
OUTERMOST = 2.0 - 1e-3
"""Contracted radius beyond which no mean goes: a distance of a thousand."""


def expand(contracted: Tensor) -> Tensor:
    """Inverse of `coordinates.contract`: points (..., 3) of the ball of radius 2 -> the whole space."""
    radius = contracted.square().sum(-1, keepdim=True).clamp_min(1.0).sqrt()
    return contracted / (radius * (2.0 - radius.clamp_max(OUTERMOST)))


class SplatTrainer:
    """3D Gaussian splatting with MCMC densification, robust losses and trust in generated views as for Zip-NeRF.

    perceptual: optional (pred (B, 3, h, w) in [0, 1], target) -> distances (B,). first: the Gaussians to begin with
    (default: `start`). The random numbers of an iteration depend on (seed, iteration) alone, so that a run continued
    from `state` goes on exactly as if it had never stopped; on the CPU the same seed gives the identical splats.
    """

    def __init__(
        self,
        config: SplatConfig,
        views: Views,
        seed: int,
        device: torch.device | str = "cpu",
        perceptual: Perceptual | None = None,
        first: Gaussians | None = None,
    ) -> None:
        self.config, self.seed, self.perceptual = config, seed, perceptual
        self.device = torch.device(device)
        self.views = views.to(self.device)
        self.iteration = self.skipped = 0
        first = start(self.views, config, self._generator("start")) if first is None else first.to(self.device)
        tensors = {name: value.detach().float().clone() for name, value in first.tensors().items()}
        tensors["means"] = contract(tensors["means"])
        self._set(tensors)

    def _generator(self, *key: str | int) -> torch.Generator:
        return torch.Generator(self.device).manual_seed(derive_seed(self.seed, "splats", *key))

    def _set(self, tensors: Mapping[str, Tensor]) -> None:
        """Optimise these tensors from now on, each with an optimiser of its own."""
        c = self.config
        self.parameters = {name: value.detach().requires_grad_() for name, value in tensors.items()}
        self.adam = {
            name: Adam({name: value}, {}, c.adam_beta1, c.adam_beta2, c.adam_eps)
            for name, value in self.parameters.items()
        }

    @property
    def gaussians(self) -> Gaussians:
        """The Gaussians as they are now; gradients flow to what is optimised."""
        tensors = dict(self.parameters)
        return Gaussians(**{**tensors, "means": expand(tensors["means"])})

    @property
    def progress(self) -> float:
        """Share of the iterations done."""
        return self.iteration / self.config.iterations

    @property
    def finished(self) -> bool:
        """All iterations are done."""
        return self.iteration >= self.config.iterations

    def learning_rates(self) -> dict[str, float]:
        """Of each tensor, for the next step."""
        c, progress = self.config, min(1.0, self.progress)
        fall = c.lr_final**progress
        means = c.lr_means * (c.lr_means_final / c.lr_means) ** progress if c.lr_means else 0.0
        others = {"log_scales": c.lr_log_scales, "quaternions": c.lr_quaternions, "logits": c.lr_logits}
        return {"means": means} | {n: lr * fall for n, lr in (others | {"harmonics": c.lr_harmonics}).items()}

    def step(self) -> dict[str, float]:
        """One iteration: loss terms, psnr of what it saw, learning rate of the means, number of Gaussians, and how many
        steps were skipped so far.

        A step whose loss or gradient is not finite changes nothing but the count. Raises NonFiniteError after more
        than `max_skipped_steps` of them.
        """
        c = self.config
        generator = self._generator("step", self.iteration)
        rates = self.learning_rates()
        for name, parameter in self.parameters.items():
            parameter.grad = None
            parameter.requires_grad_(rates[name] > 0)
        seen = draw_views(self.views, c.views_per_step, c.captured_share, generator).tolist()
        trust = losses.view_weights(self.views.cameras.centers, self.views.captured, c, self.progress)
        totals: dict[str, Tensor] = {}
        rays = float(sum(min(c.window, side[0]) * min(c.window, side[1]) for side in self.views.size[seen].tolist()))
        for view in seen:
            terms = self._losses(view, float(trust[view]), generator)
            (torch.stack([value for name, value in terms.items() if name != "mse"]).sum() / len(seen)).backward()
            for name, value in terms.items():
                totals[name] = totals.get(name, torch.zeros_like(value)) + value.detach() / len(seen)
        live = [p for p in self.parameters.values() if p.grad is not None]
        if all(bool(value.isfinite()) for value in totals.values()) and all(
            bool(p.grad.square().sum().isfinite()) for p in live if p.grad is not None
        ):
            for name, adam in self.adam.items():
                if rates[name] > 0:
                    adam.step(rates[name])
            self._move(rates["means"], generator)
        else:
            self._skip(seen, totals)
        self.iteration += 1
        result = {name: float(value) for name, value in totals.items()}
        mse = result.pop("mse")
        psnr = -10.0 * math.log10(mse) if 0.0 < mse < math.inf else math.nan
        return {
            **result,
            "loss": sum(result.values()),
            "psnr": psnr,
            "lr": rates["means"],
            "gaussians": float(len(self.parameters["logits"])),
            "rays": rays,
            "skipped": float(self.skipped),
        }

    def _window(self, side: int, within: Window, generator: torch.Generator) -> Window:
        """A window of at most `side` pixels a side, at random within another."""
        width, height = min(side, within.width), min(side, within.height)
        share = torch.rand(2, generator=generator, device=self.device).tolist()
        x, y = (int(s * (room + 1)) for s, room in zip(share, (within.width - width, within.height - height)))
        return Window(within.x0 + x, within.y0 + y, width, height)

    def _losses(self, view: int, trust: float, generator: torch.Generator) -> dict[str, Tensor]:
        c, views = self.config, self.views
        width, height = views.size[view].tolist()
        window = self._window(c.window, Window(0, 0, width, height), generator)
        part = slice(window.y0, window.y0 + window.height), slice(window.x0, window.x0 + window.width)
        target = views.image(view)[part].permute(2, 0, 1).float() / 255.0
        valid = torch.ones_like(target[0]) if views.valid is None else views.map(views.valid, view)[part].float()
        weight = trust * (valid if views.weight is None else valid * views.map(views.weight, view)[part])
        low, high = c.background
        grey = low + (high - low) * float(torch.rand((), generator=generator, device=self.device))
        gaussians, camera = self.gaussians, views.cameras[view]
        features = gaussians.colours(camera.centers[0])
        prior = losses.annealed(c.depth_prior, c.depth_prior_until, self.progress)
        known = None if views.inverse_depth is None or prior == 0 else views.map(views.inverse_depth, view)[part]
        if known is not None:
            features = torch.cat([features, self._inverse_depths(gaussians, view)[:, None]], 1)
        raster = rasterize(gaussians, camera, window, c.antialias, features)
        image = raster.features[:3] + (1.0 - raster.opacity) * grey
        difference = image - target
        terms = {
            "photometric": (losses.charbonnier(difference, c.charbonnier_eps).mean(0) * weight).mean(),
            "mse": (difference.detach().square().mean(0) * valid).sum() / valid.sum().clamp_min(1),
        }
        if known is not None and views.inverse_depth_weight is not None:
            share = trust * valid * views.map(views.inverse_depth_weight, view)[part]
            terms["depth"] = prior * (share * losses.charbonnier(raster.features[3] - known, 1e-3)).mean()
        if c.ssim_weight:
            alike = ssim_map(image[None], target[None], "gaussian_same")[0].mean(0).to(weight)
            terms["ssim"] = c.ssim_weight * ((1.0 - alike) * weight).mean()
        if self.perceptual is not None and c.lpips_weight and self.iteration % c.lpips_every == 0:
            patch = self._window(c.patch_size, Window(0, 0, window.width, window.height), generator)
            rows, columns = slice(patch.y0, patch.y0 + patch.height), slice(patch.x0, patch.x0 + patch.width)
            prediction, truth = ((picture * valid)[None, :, rows, columns] for picture in (image, target))
            distance = self.perceptual(prediction.clamp(0.0, 1.0).contiguous(), truth.contiguous()).mean()
            terms["perceptual"] = c.lpips_every * c.lpips_weight * weight[rows, columns].mean() * distance
        if c.opacity_weight:
            terms["opacity"] = c.opacity_weight * gaussians.opacities.mean()
        if c.scale_weight:
            distance = gaussians.means.detach().norm(dim=-1, keepdim=True).clamp_min(1.0)
            terms["scale"] = c.scale_weight * (gaussians.scales / distance).mean()
        return terms

    def _inverse_depths(self, gaussians: Gaussians, view: int) -> Tensor:
        """(N,) of the means in a view; 0 behind it."""
        pose = self.views.cameras.camera_from_world[view]
        depth = gaussians.means @ pose[2, :3] + pose[2, 3]
        return torch.where(depth > losses.NEAREST, 1.0 / depth.clamp_min(losses.NEAREST), 0.0)

    @torch.no_grad()
    def _move(self, rate: float, generator: torch.Generator) -> None:
        """Noise, and at some steps the relocation of dead Gaussians and the addition of new ones."""
        c = self.config
        gaussians = self.gaussians
        means = gaussians.means
        if c.noise and rate:
            means = means + noise(gaussians, c.noise * rate / c.lr_means, generator)
        radius = means.norm(dim=-1)
        if c.noise or bool((radius > 1 / (2 - OUTERMOST)).any()):
            self.parameters["means"].copy_(contract(means))
        if c.density_every and (self.iteration + 1) % c.density_every == 0 and self.progress < c.density_until:
            count = len(gaussians)
            move = relocate(self.gaussians, min(c.most, int(count * c.grow)) - count, c.dead_opacity, generator)
            self._replace(move.gaussians, move.changed)

    def _replace(self, gaussians: Gaussians, changed: Tensor) -> None:
        """Go on with these Gaussians; the optimiser keeps what it knows of rows that did not change."""
        before = self.adam
        tensors = {name: value.clone() for name, value in gaussians.tensors().items()}
        tensors["means"] = contract(tensors["means"])
        self._set(tensors)
        for name, adam in self.adam.items():
            for new, old in ((adam.mean, before[name].mean), (adam.square, before[name].square)):
                new[name][: len(old[name])] = old[name]
                new[name][changed] = 0.0
            adam.steps[name].copy_(before[name].steps[name])

    def _skip(self, seen: list[int], totals: dict[str, Tensor]) -> None:
        self.skipped += 1
        if self.skipped > self.config.max_skipped_steps:
            terms = ", ".join(f"{name}={float(value):g}" for name, value in totals.items())
            raise NonFiniteError(
                f"{self.skipped} training steps up to iteration {self.iteration} had a non-finite loss or gradient "
                f"({terms}; the last one saw the views {seen}). Check these views' cameras and images, or lower the "
                "learning rates."
            )

    def state(self) -> dict[str, Tensor]:
        """Everything an exact continuation needs, as flat named tensors (safetensors-friendly, copies)."""
        state = {f"splats.{name}": value for name, value in self.parameters.items()}
        for adam in self.adam.values():
            state |= {f"adam.{name}": value for name, value in adam.state().items()}
        state |= {"trainer.iteration": torch.tensor(self.iteration), "trainer.skipped": torch.tensor(self.skipped)}
        return {name: value.detach().cpu().clone() for name, value in state.items()}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Continue from `state()`. Raises ValueError where it does not fit."""
        names = set(self.state())
        if names - set(state) or state["splats.harmonics"].shape[1:] != self.parameters["harmonics"].shape[1:]:
            raise ValueError(
                "The training state does not fit these splats: "
                f"{', '.join(sorted(names - set(state))) or 'another degree of the colours'}. Start the reconstruction "
                "anew, or use the config that made the state."
            )
        self._set({n: state[f"splats.{n}"].to(self.device).clone() for n in self.parameters})
        for adam in self.adam.values():
            adam.load_state({n.removeprefix("adam."): v for n, v in state.items() if n.startswith("adam.")})
        self.iteration, self.skipped = int(state["trainer.iteration"]), int(state["trainer.skipped"])


def splats_of_state(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The tensors of the Gaussians that a `SplatTrainer.state` holds."""
    found = {n.removeprefix("splats."): v for n, v in state.items() if n.startswith("splats.")}
    return found | {"means": expand(found["means"])}


def train(trainer: SplatTrainer) -> Gaussians:
    """Run the training to its end."""
    while not trainer.finished:
        trainer.step()
    return trainer.gaussians.detach()
