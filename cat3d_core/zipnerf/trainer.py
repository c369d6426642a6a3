"""Training of one field from posed views, deterministic and resumable."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import math
from collections.abc import Callable, Iterator, Mapping

import torch
from torch import Tensor

from cat3d_core.random import derive_seed
from cat3d_core.reconstruction.protocol import NonFiniteError
from cat3d_core.reconstruction.views import Batch, Views, draw_batch
from cat3d_core.zipnerf import losses
from cat3d_core.zipnerf.adam import Adam
from cat3d_core.zipnerf.config import ZipNerfConfig
from cat3d_core.zipnerf.field import Field
from cat3d_core.zipnerf.render import render_rays

_KEPT_BYTES = 1 << 30


@functools.cache
def _keep_freed_memory() -> None:
    """Let glibc keep what a step frees for the next one: handing it back to the system costs an eighth of a step in
    page faults. Other C libraries go on as they are."""
    with contextlib.suppress(OSError, AttributeError):
        library = ctypes.CDLL(None)
        library.mallopt(ctypes.c_int(-3), ctypes.c_int(_KEPT_BYTES))  # M_MMAP_THRESHOLD
        library.mallopt(ctypes.c_int(-1), ctypes.c_int(_KEPT_BYTES))  # M_TRIM_THRESHOLD


Perceptual = Callable[[Tensor, Tensor], Tensor]


class Trainer:
    """Robust Zip-NeRF training (CAT3D sec. 'Robust 3D reconstruction').

    perceptual: optional (pred (B, 3, h, w) in [0, 1], target) -> distances (B,); without it no patches are drawn. The
    random numbers of an iteration depend on (seed, iteration) alone, so that a run continued from `state` goes on
    exactly as if it had never stopped; on the CPU the same seed and number of threads give the identical field.
    """

    def __init__(
        self,
        config: ZipNerfConfig,
        views: Views,
        seed: int,
        device: torch.device | str = "cpu",
        perceptual: Perceptual | None = None,
    ) -> None:
        self.config, self.seed, self.perceptual = config, seed, perceptual
        self.device = torch.device(device)
        if self.device.type == "cpu":
            _keep_freed_memory()
        self.views = views.to(self.device)
        self.field = Field(config, seed).to(self.device)
        parameters: dict[str, Tensor] = dict(self.field.named_parameters())
        decay = {
            f"grids.{index}.table": [(first, last, config.weight_decay) for first, last in grid.level_rows()]  # type: ignore[operator]
            for index, grid in enumerate(self.field.grids)
        }
        self.adam = Adam(parameters, decay, config.adam_beta1, config.adam_beta2, config.adam_eps)
        self.iteration = 0
        self.skipped = 0
        self.best_error, self.stale_checks = math.inf, 0
        self.plateau_at = -1  # the iteration from which the schedule is cut short
        self._held_out: Batch | None = None
        if config.plateau_patience:
            generator = torch.Generator(self.device).manual_seed(derive_seed(seed, "nerf", "held out"))
            self._held_out = draw_batch(self.views, config.plateau_pixels, 1, 1.0, generator)
            self.views = self.views.without(self._held_out)
        self._coarse = self.views.halved() if config.low_resolution_iterations else None

    @property
    def progress(self) -> float:
        """Position in the schedule, 0 to 1: the share of iterations done, quicker after a plateau."""
        c = self.config
        if self.plateau_at < 0:
            return self.iteration / c.iterations
        start, cooldown = self.plateau_at / c.iterations, c.plateau_cooldown * c.iterations
        since = self.iteration - self.plateau_at
        return start + (1.0 - start) * since / cooldown if since < cooldown else 1.0

    @property
    def finished(self) -> bool:
        """The schedule is run through."""
        return self.progress >= 1.0

    def learning_rate(self) -> float:
        """Logarithmic decay times Zip-NeRF's sine warm-up, for the next step."""
        c = self.config
        progress = min(1.0, self.progress)
        lr = math.exp((1.0 - progress) * math.log(c.lr_init) + progress * math.log(c.lr_final))
        if self.iteration < c.warmup_iterations:
            warm = math.sin(0.5 * math.pi * self.iteration / c.warmup_iterations)
            lr *= c.warmup_scale + (1.0 - c.warmup_scale) * warm
        return lr

    def step(self) -> dict[str, float]:
        """One iteration: loss terms, psnr of the batch, learning rate, and how many steps were skipped so far.

        A step whose loss or gradient is not finite changes nothing but the count. Raises NonFiniteError after more than
        `max_skipped_steps` of them, ValueError for views smaller than a patch.
        """
        c = self.config
        progress = self.progress
        generator = torch.Generator(self.device).manual_seed(derive_seed(self.seed, "nerf", "step", self.iteration))
        views = (
            self._coarse if self._coarse is not None and self.iteration < c.low_resolution_iterations else self.views
        )
        trust = losses.view_weights(views.cameras.centers, views.captured, c, progress)
        for parameter in self.adam.parameters.values():
            parameter.grad = None
        totals: dict[str, Tensor] = {}
        batches = self._draw(views, generator)
        for batch, share in self._chunks(batches):
            terms = self._losses(views, batch, trust, progress, share, generator)
            torch.stack([value for name, value in terms.items() if name != "mse"]).sum().backward()
            for name, value in terms.items():
                totals[name] = totals.get(name, torch.zeros_like(value)) + value.detach()
        lr = self.learning_rate()
        if not bool(torch.isfinite(torch.stack([*totals.values()])).all()) or not self.adam.step(lr):
            self._skip(views, batches, totals)
        self.iteration += 1
        settled = self.iteration > max(c.warmup_iterations, c.low_resolution_iterations, c.plateau_from * c.iterations)
        if self._held_out is not None and settled and self.plateau_at < 0 and self.iteration % c.plateau_every == 0:
            self._check_plateau(self._held_out)
        result = {name: float(value) for name, value in totals.items()}
        mse = result.pop("mse")
        psnr = -10.0 * math.log10(mse) if 0.0 < mse < math.inf else math.nan
        return {**result, "loss": sum(result.values()), "psnr": psnr, "lr": lr, "skipped": float(self.skipped)}

    def _draw(self, views: Views, generator: torch.Generator) -> list[Batch]:
        c = self.config
        patches = 0
        perceptual = self.perceptual is not None and c.lpips_weight > 0.0 and c.patch_share > 0.0
        if perceptual and views is self.views and self.iteration % c.lpips_every == 0:
            patches = max(1, round(c.patch_share * c.batch_rays / c.patch_size**2))
        singles = max(0, c.batch_rays - patches * c.patch_size**2) if c.patch_share < 1.0 or not patches else 0
        batches = []
        if patches:
            batches.append(draw_batch(views, patches, c.patch_size, c.captured_share, generator))
        if singles:
            batches.append(draw_batch(views, singles, 1, c.captured_share, generator))
        return batches

    def _chunks(self, batches: list[Batch]) -> Iterator[tuple[Batch, dict[str, float]]]:
        """Pieces of at most chunk_rays rays (or one patch), with their share of all rays and of all patches."""
        total = sum(len(batch.view) for batch in batches)
        for batch in batches:
            area = batch.patch**2
            size = max(1, self.config.chunk_rays // area) * area
            for first in range(0, len(batch.view), size):
                piece = batch.part(slice(first, first + size))
                yield piece, {"rays": len(piece.view) / total, "patches": len(piece.view) / len(batch.view)}

    def _losses(
        self,
        views: Views,
        batch: Batch,
        trust: Tensor,
        progress: float,
        share: dict[str, float],
        generator: torch.Generator,
    ) -> dict[str, Tensor]:
        c = self.config
        rays = views.pinholes.rays(batch.view, batch.xy + 0.5)
        anneal = c.anneal_slope * progress / ((c.anneal_slope - 1.0) * progress + 1.0)
        proposals = self.iteration < c.warmup_iterations or self.iteration % c.proposal_every == 0
        out = render_rays(self.field, rays, anneal, generator, proposals)
        weight = trust[batch.view] * batch.weight
        difference = out.rgb - batch.rgb
        photometric = (losses.charbonnier(difference, c.charbonnier_eps).mean(-1) * weight).mean()
        terms = {
            "photometric": photometric * share["rays"],
            "distortion": c.distortion_weight * losses.distortion(out.rounds[-1], c) * share["rays"],
            "mse": (difference.detach().square().mean(-1) * batch.valid).mean() * share["rays"],
        }
        if proposals:
            inter = losses.interlevel(out.rounds[:-1], out.rounds[-1], c.interlevel_blur)
            terms["interlevel"] = c.interlevel_weight * inter * share["rays"]
        prior = losses.annealed(c.depth_prior, c.depth_prior_until, progress)
        if prior > 0.0 and batch.inverse_depth is not None and batch.inverse_depth_weight is not None:
            known = trust[batch.view] * batch.valid * batch.inverse_depth_weight
            terms["depth"] = prior * losses.inverse_depth(out.rounds[-1], batch.inverse_depth, known) * share["rays"]
        if batch.patch > 1 and self.perceptual is not None:
            shape = (-1, batch.patch, batch.patch, 3)
            valid = batch.valid[:, None]
            prediction, target = (
                (image * valid).view(shape).permute(0, 3, 1, 2).contiguous() for image in (out.rgb, batch.rgb)
            )
            distance = self.perceptual(prediction.clamp(0.0, 1.0), target)
            trusted = trust[batch.view[:: batch.patch**2]]
            if views.weight is not None:
                trusted = trusted * batch.weight.view(-1, batch.patch**2).mean(1)
            terms["perceptual"] = c.lpips_every * c.lpips_weight * (distance * trusted).mean() * share["patches"]
        return terms

    @torch.no_grad()
    def _check_plateau(self, held_out: Batch) -> None:
        rays = self.views.pinholes.rays(held_out.view, held_out.xy + 0.5)
        error = float((render_rays(self.field, rays).rgb - held_out.rgb).abs().mean())
        # NaN compares as no progress: a field that broke does not hold training up.
        if error < self.best_error * (1.0 - self.config.plateau_tolerance):
            self.best_error, self.stale_checks = error, 0
        else:
            self.stale_checks += 1
        if self.stale_checks >= self.config.plateau_patience:
            self.plateau_at = self.iteration

    @torch.no_grad()
    def _skip(self, views: Views, batches: list[Batch], totals: dict[str, Tensor]) -> None:
        self.skipped += 1
        if self.skipped <= self.config.max_skipped_steps:
            return
        culprits = []
        for batch in batches:
            rgb = render_rays(self.field, views.pinholes.rays(batch.view, batch.xy + 0.5)).rgb
            bad = (~torch.isfinite(rgb).all(-1) | ~torch.isfinite(batch.rgb).all(-1)).nonzero()[:8, 0]
            culprits += [f"view {int(batch.view[i])} pixel {batch.xy[i].tolist()}" for i in bad]
        terms = ", ".join(f"{name}={float(value):g}" for name, value in totals.items())
        gradients = [
            n for n, p in self.adam.parameters.items() if p.grad is not None and not torch.isfinite(p.grad).all()
        ]
        drawn = sorted({int(view) for batch in batches for view in batch.view.unique()})
        raise NonFiniteError(
            f"{self.skipped} training steps up to iteration {self.iteration} had a non-finite loss or gradient "
            f"({terms}; gradients of {', '.join(gradients) or 'no parameter'}). Rays that render non-finite colours: "
            f"{'; '.join(culprits) or 'none'}; views of this batch: {drawn}. "
            "Check these views' cameras and images, or lower lr_init."
        )

    def state(self) -> dict[str, Tensor]:
        """Everything an exact continuation needs, as flat named tensors (safetensors-friendly, copies)."""
        state = {f"field.{name}": value for name, value in self.field.state_dict().items()}
        state |= {f"adam.{name}": value for name, value in self.adam.state().items()}
        state |= {"trainer.iteration": torch.tensor(self.iteration), "trainer.skipped": torch.tensor(self.skipped)}
        state |= {
            "trainer.best_error": torch.tensor(self.best_error, dtype=torch.float64),
            "trainer.stale_checks": torch.tensor(self.stale_checks),
            "trainer.plateau_at": torch.tensor(self.plateau_at),
        }
        return {name: value.detach().cpu().clone() for name, value in state.items()}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Continue from `state()`. Raises ValueError where it does not fit the config."""
        own = self.state()
        for name, value in own.items():
            if name not in state or state[name].shape != value.shape:
                found = tuple(state[name].shape) if name in state else "missing"
                raise ValueError(
                    f"The training state does not fit this config: {name} is {found}, expected {tuple(value.shape)}. "
                    "Start the reconstruction anew, or use the config that made the state."
                )
        self.field.load_state_dict({n.removeprefix("field."): v for n, v in state.items() if n.startswith("field.")})
        self.adam.load_state({n.removeprefix("adam."): v for n, v in state.items() if n.startswith("adam.")})
        self.iteration, self.skipped = int(state["trainer.iteration"]), int(state["trainer.skipped"])
        self.best_error, self.stale_checks = float(state["trainer.best_error"]), int(state["trainer.stale_checks"])
        self.plateau_at = int(state["trainer.plateau_at"])
