"""Adam with the normalised weight decay of Zip-NeRF."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.optim.adam import adam


class Adam:
    """torch's fused Adam over named float32 parameters, with decay 0.5 * c * mean(v^2) on named groups of rows.

    decay: parameter name -> list of (first row, last row, c): its gradient c * v / count is added in float32 here, not
    by autograd over all tables (on an 8M-entry level it is 1e-13, lost in half precision). Adam is invariant to the
    scale of gradients, so even these pull untouched entries to zero at full speed; eps must stay tiny and steps dense.
    """

    def __init__(
        self,
        parameters: dict[str, Tensor],
        decay: dict[str, list[tuple[int, int, float]]],
        beta1: float,
        beta2: float,
        eps: float,
    ) -> None:
        self.parameters = parameters
        self.decay = decay
        self.beta1, self.beta2, self.eps = beta1, beta2, eps
        self.mean = {name: torch.zeros_like(p) for name, p in parameters.items()}
        self.square = {name: torch.zeros_like(p) for name, p in parameters.items()}
        self.steps = {name: torch.zeros((), dtype=torch.float32, device=p.device) for name, p in parameters.items()}

    @torch.no_grad()
    def step(self, lr: float) -> None:
        """One update of every parameter that has a gradient; the gradients are left as they are."""
        for name, groups in self.decay.items():
            parameter = self.parameters[name]
            if parameter.grad is not None:
                for first, last, strength in groups:
                    rows = parameter[first:last]
                    parameter.grad[first:last].add_(rows, alpha=strength / rows.numel())
        live = [name for name, p in self.parameters.items() if p.grad is not None]
        adam(
            [self.parameters[name] for name in live],
            [g for name in live if (g := self.parameters[name].grad) is not None],
            [self.mean[name] for name in live],
            [self.square[name] for name in live],
            [],
            [self.steps[name] for name in live],
            fused=True, amsgrad=False, maximize=False, weight_decay=0.0,
            lr=lr, beta1=self.beta1, beta2=self.beta2, eps=self.eps,
        )  # fmt: skip

    def state(self) -> dict[str, Tensor]:
        """Moments and step counts, by flat name."""
        kinds = {"mean": self.mean, "square": self.square, "steps": self.steps}
        return {f"{kind}.{name}": value for kind, values in kinds.items() for name, value in values.items()}

    def load_state(self, state: dict[str, Tensor]) -> None:
        for name, target in self.state().items():
            target.copy_(state[name])
