"""Training the multi-view denoiser: the loss, one step, EMA, exact resumption; alone or data-parallel under
torchrun."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn

from cat3d_core.diffusion.conditioning import Drop, drop_condition, make_condition
from cat3d_core.diffusion.hints import CONFIDENCE, corrupted
from cat3d_core.diffusion.model import MultiViewModel
from cat3d_core.diffusion.schedule import Schedule, alpha_sigma
from cat3d_core.diffusion.unet import MultiViewUNet
from cat3d_core.random import generator


@dataclass(frozen=True)
class TrainConfig:
    """Paper (appendix A): lr 5e-5 fine-tuning at batch 128, drop probability 0.1. For training from scratch see
    'small'.

    total_steps counts optimizer steps; the learning rate rises linearly for `warmup_steps`, then follows a half cosine
    down to `final_learning_rate` at total_steps. accumulate: calls of `step` per optimizer step. hint_weight: weight of
    the loss where a hint is wholly certain, as against 1 where it is not: there the finished view shows the hint and
    not the sample. min_snr_gamma: weight of Hang et al. 2023 (None: uniform). precision: bfloat16 keeps float32 master
    weights.
    """

    learning_rate: float = 5e-5
    final_learning_rate: float = 5e-5
    warmup_steps: int = 100
    total_steps: int = 100_000
    weight_decay: float = 0.01
    clip_norm: float = 1.0
    ema_decay: float = 0.9995
    accumulate: int = 1
    drop_probability: float = 0.1
    drop: Drop = "images_and_poses"
    hint_weight: float = 0.25
    min_snr_gamma: float | None = None
    precision: Literal["float32", "bfloat16"] = "bfloat16"

    def learning_rate_at(self, step: int) -> float:
        if step < self.warmup_steps:
            return self.learning_rate * (step + 1) / self.warmup_steps
        progress = (step - self.warmup_steps) / max(self.total_steps - self.warmup_steps, 1)
        return half_cosine(self.learning_rate, self.final_learning_rate, progress)


def half_cosine(first: float, last: float, progress: float) -> float:
    """From `first` at progress 0 to `last` at 1 and beyond, along half a cosine."""
    return last + (first - last) * 0.5 * (1 + math.cos(math.pi * min(progress, 1.0)))


def diffusion_loss(
    unet: MultiViewUNet,
    schedule: Schedule,
    latents: Tensor,
    cameras: Tensor,
    n_condition: int,
    random: torch.Generator,
    config: TrainConfig,
    hints: Tensor | None = None,
) -> Tensor:
    """Mean squared error of the prediction on target views, one value per group [G] float32.

    latents [G, V, C, h, w] clean, conditioning views first (they stay clean); cameras [G, V, 4, 4] as
    the network wants them; hints [G, N, C + 4, h, w] of the targets, corrupted here. Noise levels are
    stratified over the groups. `random` is a CPU generator, so the draw is the same on every device.
    """
    groups = latents.shape[0]
    latents = latents.float()
    step = (torch.rand((), generator=random) + torch.arange(groups)) / groups % 1.0 * schedule.config.steps
    log_snr = schedule.log_snr[step.long().clamp(max=schedule.config.steps - 1)]
    dropped = torch.rand(groups, generator=random) < config.drop_probability
    clean = latents[:, n_condition:]
    noise = torch.randn(clean.shape, generator=random).to(clean.device)
    alpha, sigma = (s.float().to(clean.device)[:, None, None, None, None] for s in alpha_sigma(log_snr))
    noisy = alpha * clean + sigma * noise
    told = None if hints is None else corrupted(hints, random)
    condition = drop_condition(
        make_condition(latents[:, :n_condition], cameras, told), dropped.to(clean.device), config.drop
    )
    time = schedule.time(log_snr).float().to(clean.device)
    output = unet(torch.cat([condition.latents, noisy], 1), time, condition.cameras, condition.mask, condition.hints)
    target = alpha * noise - sigma * clean if schedule.config.prediction == "v" else noise
    square = (output[:, n_condition:].float() - target).square()
    if told is not None:
        square = square * (1 - (1 - config.hint_weight) * told[:, :, CONFIDENCE, None].float())
    error = square.mean((1, 2, 3, 4))
    return error * _snr_weight(log_snr, schedule.config.prediction, config.min_snr_gamma).to(error)


def _snr_weight(log_snr: Tensor, prediction: str, gamma: float | None) -> Tensor:
    """min(SNR, gamma) as a weight on the clean latent's error, expressed for v (SNR + 1) or eps (SNR)."""
    if gamma is None:
        return torch.ones_like(log_snr)
    snr = log_snr.exp()
    return snr.clamp(max=gamma) / (snr + 1 if prediction == "v" else snr)


class Trainer:
    """Trains `model.unet`. The numbers drawn in a step depend on (seed, step, rank) alone, so a run that is stopped and
    loaded again continues as if it had not been. Under torch.distributed gradients are averaged over ranks.

    `model` itself is not changed; `ema_model()` gives the model to sample from or to save.
    """

    def __init__(
        self, config: TrainConfig, model: MultiViewModel, seed: int, device: torch.device | str = "cpu"
    ) -> None:
        self.config = config
        self.seed = seed
        self.device = torch.device(device)
        self.model_config = model.config
        self.autoencoder = model.autoencoder
        self.calls = 0  # calls of `step` so far
        dtype = torch.bfloat16 if config.precision == "bfloat16" else torch.float32
        self.unet = copy.deepcopy(model.unet).to(self.device, dtype).train().requires_grad_(True)
        self.names = [name for name, _ in self.unet.named_parameters()]
        self.weights: list[Tensor] = [p for _, p in self.unet.named_parameters()]
        own = dict(model.unet.named_parameters())
        self.masters = [own[n].detach().to(self.device, torch.float32, copy=True) for n in self.names]
        self.ema = [m.clone() for m in self.masters]
        for master in self.masters:
            master.grad = torch.zeros_like(master)
        self.optimizer = torch.optim.AdamW(
            self.masters, lr=config.learning_rate, weight_decay=config.weight_decay, betas=(0.9, 0.99), fused=True
        )
        self._publish()

    @property
    def steps(self) -> int:
        """Optimizer steps made."""
        return self.calls // self.config.accumulate

    def step(self, latents: Tensor, cameras: Tensor, n_condition: int, hints: Tensor | None = None) -> dict[str, float]:
        """One batch: latents [G, V, C, h, w], cameras [G, V, 4, 4], conditioning views first; hints [G, N, C + 4, h, w]
        of the others, for a network that takes them.

        Returns numbers to log: step, loss, lr, grad_norm (nan unless this call ended an accumulation). Raises
        FloatingPointError if the loss or the gradient is not finite; the weights are then those of the last good step.
        """
        rank, world = _rank_and_world()
        schedule = Schedule(self.model_config.schedule, latents.shape[1] - n_condition)
        random = generator(self.seed, "train", self.calls, rank)
        latents, cameras = latents.to(self.device), cameras.to(self.device)
        hints = None if hints is None else hints.to(self.device)
        loss = diffusion_loss(self.unet, schedule, latents, cameras, n_condition, random, self.config, hints).mean()
        value = float(loss.detach())
        if not math.isfinite(value):
            raise FloatingPointError(f"The training loss is {value} at step {self.steps}; lower the learning rate.")
        loss.backward()
        for weight, master in zip(self.weights, self.masters, strict=True):
            if weight.grad is not None and master.grad is not None:
                master.grad.add_(weight.grad, alpha=1 / (self.config.accumulate * world))
                weight.grad = None
        self.calls += 1
        norm = math.nan
        if self.calls % self.config.accumulate == 0:
            norm = self._update(world)
        rate = self.config.learning_rate_at(max(self.steps - 1, 0))
        return {"step": self.steps, "loss": value, "lr": rate, "grad_norm": norm}

    def _update(self, world: int) -> float:
        gradients = [m.grad for m in self.masters if m.grad is not None]
        if world > 1:
            flat = torch.cat([g.flatten() for g in gradients])
            torch.distributed.all_reduce(flat)
            for gradient, part in zip(gradients, flat.split([g.numel() for g in gradients]), strict=True):
                gradient.copy_(part.view_as(gradient))
        norm = nn.utils.clip_grad_norm_(self.masters, self.config.clip_norm)
        if not bool(norm.isfinite()):  # clipping by it would make every weight NaN
            for gradient in gradients:
                gradient.zero_()
            raise FloatingPointError(f"The gradient's norm is {norm:g} at step {self.steps}; lower the learning rate.")
        for group in self.optimizer.param_groups:
            group["lr"] = self.config.learning_rate_at(self.steps - 1)
        self.optimizer.step()
        for gradient in gradients:
            gradient.zero_()
        # A short average at first, so that the random start is forgotten.
        decay = min(self.config.ema_decay, (1 + self.steps) / (10 + self.steps))
        torch._foreach_lerp_(self.ema, self.masters, 1 - decay)
        self._publish()
        return float(norm)

    @torch.no_grad()
    def _publish(self) -> None:
        """Copy the master weights into the network, rounded to its precision."""
        torch._foreach_copy_(self.weights, self.masters)

    def ema_model(self) -> MultiViewModel:
        """A model with the averaged weights (float32, on the CPU, eval mode)."""
        return self._model(self.ema)

    def _model(self, weights: list[Tensor]) -> MultiViewModel:
        with torch.device("meta"):
            model = MultiViewModel(self.model_config)
        model.unet.load_state_dict(
            {n: w.detach().cpu().clone() for n, w in zip(self.names, weights, strict=True)}, assign=True
        )
        model.autoencoder = copy.deepcopy(self.autoencoder)
        return model.cpu().eval().requires_grad_(False)

    def state(self) -> dict[str, Tensor]:
        """Everything a resumed run needs, as tensors (for `checkpoint.save_state`)."""
        state = {"calls": torch.tensor(self.calls), "seed": torch.tensor(self.seed)}
        for i, name in enumerate(self.names):
            state[f"master.{name}"] = self.masters[i].detach()
            state[f"ema.{name}"] = self.ema[i]
            state[f"gradient.{name}"] = self.masters[i].grad  # type: ignore[assignment]
            for key, value in self.optimizer.state.get(self.masters[i], {}).items():
                state[f"{key}.{name}"] = value
        return {key: value.clone() for key, value in state.items()}

    @torch.no_grad()
    def load_state(self, state: dict[str, Tensor]) -> None:
        """Continue from `state()`. Raises ValueError if it belongs to another network."""
        if {k[7:] for k in state if k.startswith("master.")} != set(self.names):
            raise ValueError(
                "This training state belongs to a network with other weights; use the configuration it was saved with."
            )
        self.calls, self.seed = int(state["calls"]), int(state["seed"])
        for i, name in enumerate(self.names):
            master = self.masters[i]
            master.copy_(state[f"master.{name}"])
            self.ema[i].copy_(state[f"ema.{name}"])
            master.grad = state[f"gradient.{name}"].to(self.device, copy=True)
            if f"exp_avg.{name}" in state:
                keys = ("step", "exp_avg", "exp_avg_sq")
                self.optimizer.state[master] = {k: state[f"{k}.{name}"].to(self.device, copy=True) for k in keys}
        self._publish()


def _rank_and_world() -> tuple[int, int]:
    if torch.distributed.is_available() and torch.distributed.is_initialized():
        return torch.distributed.get_rank(), torch.distributed.get_world_size()
    return 0, 1
