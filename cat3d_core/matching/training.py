"""Training the plane sweep's network: one optimizer step at a time, from a state that can be saved."""

from __future__ import annotations

import contextlib
import copy
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from cat3d_core.matching.losses import WEIGHTS, SweepBatch, losses
from cat3d_core.matching.network import SweepNetwork, Swept
from cat3d_core.matching.photos import Observed


@dataclass(frozen=True)
class SweepTrainConfig:
    """AdamW and the average of the weights."""

    weight_decay: float = 0.01
    clip_norm: float = 1.0
    ema_decay: float = 0.998
    precision: str = "bfloat16"


class SweepTrainer:
    """Trains a copy of `network`; `averaged()` gives the one to keep."""

    def __init__(self, config: SweepTrainConfig, network: SweepNetwork, device: torch.device | str = "cpu") -> None:
        self.config, self.device, self.steps = config, torch.device(device), 0
        self.network = copy.deepcopy(network).to(self.device).train().requires_grad_(True)
        self.average = copy.deepcopy(self.network).requires_grad_(False)
        self.optimizer = torch.optim.AdamW(
            self.network.parameters(), lr=0.0, weight_decay=config.weight_decay, betas=(0.9, 0.98), fused=True
        )

    def step(self, batch: SweepBatch, rate: float) -> dict[str, float]:
        """One batch at this learning rate. Returns the terms of the loss, `loss` and `gradient_norm`.

        A batch whose loss or gradient is not finite changes nothing; its numbers show it."""
        batch = batch.to(self.device)
        with half(self.config.precision, self.device):
            out, observed = forward(self.network, batch)
        terms = losses(out, observed, batch, self.network.config.nearest)
        loss = torch.stack([WEIGHTS[name] * term for name, term in terms.items()]).sum()
        self.optimizer.zero_grad()
        loss.backward()
        norm = nn.utils.clip_grad_norm_(self.network.parameters(), self.config.clip_norm)
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        if bool(norm.isfinite()):
            self.optimizer.step()
        self.steps += 1
        # A short average at first, so that the random start is forgotten.
        decay = min(self.config.ema_decay, (1 + self.steps) / (10 + self.steps))
        with torch.no_grad():
            torch._foreach_lerp_(list(self.average.parameters()), list(self.network.parameters()), 1 - decay)
        numbers = {name: float(term.detach()) for name, term in terms.items()}
        return numbers | {"loss": float(loss.detach()), "gradient_norm": float(norm)}

    def averaged(self) -> SweepNetwork:
        """The averaged weights (float32, on the CPU, eval mode)."""
        return copy.deepcopy(self.average).cpu().eval()

    def state(self) -> dict[str, Tensor]:
        """Everything that a resumed training needs, as tensors."""
        out = {"steps": torch.tensor(self.steps)}
        averages = dict(self.average.named_parameters())
        for name, weight in self.network.named_parameters():
            out[f"weight.{name}"], out[f"average.{name}"] = weight.detach(), averages[name].detach()
            for key, value in self.optimizer.state.get(weight, {}).items():
                out[f"{key}.{name}"] = value
        return {name: tensor.clone() for name, tensor in out.items()}

    @torch.no_grad()
    def load_state(self, state: dict[str, Tensor]) -> None:
        """Continue from `state()`. Raises ValueError if it belongs to another network."""
        names = [name for name, _ in self.network.named_parameters()]
        if {k.removeprefix("weight.") for k in state if k.startswith("weight.")} != set(names):
            raise ValueError(
                "This training state belongs to a network with other weights; use the configuration it was saved with."
            )
        self.steps = int(state["steps"])
        averages = dict(self.average.named_parameters())
        for name, weight in self.network.named_parameters():
            weight.copy_(state[f"weight.{name}"])
            averages[name].copy_(state[f"average.{name}"])
            if f"exp_avg.{name}" in state:
                keys = ("step", "exp_avg", "exp_avg_sq")
                self.optimizer.state[weight] = {k: state[f"{k}.{name}"].to(self.device, copy=True) for k in keys}


def forward(network: SweepNetwork, batch: SweepBatch) -> tuple[Swept, Observed]:
    """The network's answer to a batch."""
    observed = network.observe(batch.image, batch.views, batch.partners)
    height, width = batch.truth.shape[-2:]
    return network(observed, batch.photos, batch.target, height, width), observed


def half(precision: str, device: torch.device) -> contextlib.AbstractContextManager[object]:
    """Autocast to bfloat16, or nothing."""
    if precision == "bfloat16":
        return torch.autocast(device.type, torch.bfloat16)
    return contextlib.nullcontext()


@torch.no_grad()
def validation_psnr(network: SweepNetwork, batch: SweepBatch, precision: str = "bfloat16") -> float:
    """Mean PSNR of the batch's targets, in decibels."""
    with half(precision, batch.image.device):
        out, _ = forward(network, batch)
    error = (out.colour.clamp(0, 1) - batch.truth).square().mean((1, 2, 3)).clamp(min=1e-10)
    return float(-10 * error.log10().mean())
