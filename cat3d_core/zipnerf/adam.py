"""Adam with the normalised weight decay of Zip-NeRF."""

from __future__ import annotations

import ctypes

import torch
from torch import Tensor
from torch.optim.adam import adam

from cat3d_core.cpu_library import library


class Adam:
    """Adam over named float32 parameters, with decay 0.5 * c * mean(v^2) on named groups of rows.

    It is torch's fused one, or on the CPU a kernel that reads everything once.

    decay: parameter name -> list of (first row, last row, c), which hold all rows: its gradient c * v / count is added
    in float32 here, not by autograd over all tables (on an 8M-entry level it is 1e-13, lost in half precision). Adam is
    invariant to the scale of gradients, so even these pull untouched entries to zero at full speed; eps must stay tiny
    and steps dense.
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
    def step(self, lr: float) -> bool:
        """One update of every parameter that has a gradient. Where the square of one is not finite, nothing changes and
        the answer is False: a gradient beyond 1e19 would freeze its parameter with an infinite second moment."""
        eps = self.eps
        live = {name: p for name, p in self.parameters.items() if p.grad is not None}
        if not live:
            return True
        gradients = [p.grad for p in live.values() if p.grad is not None]
        tensors = [*live.values(), *gradients, *(self.mean[name] for name in live)]
        plain = all(x.dtype == torch.float32 and x.device.type == "cpu" and x.is_contiguous() for x in tensors)
        kernels = library("zipnerf/adam") if plain else None
        if kernels is not None:
            return self._step_by_kernel(kernels, live, lr, eps)
        largest = torch._foreach_norm(gradients, torch.inf)
        if not bool(torch.isfinite(torch.stack(largest).square()).all()):
            return False
        for name, parameter in live.items():
            for first, last, strength in self.decay.get(name, []):
                rows = parameter[first:last]
                parameter.grad[first:last].add_(rows, alpha=strength / rows.numel())  # type: ignore[index]
        adam(
            list(live.values()),
            gradients,
            [self.mean[name] for name in live],
            [self.square[name] for name in live],
            [],
            [self.steps[name] for name in live],
            fused=True, amsgrad=False, maximize=False, weight_decay=0.0,
            lr=lr, beta1=self.beta1, beta2=self.beta2, eps=eps,
        )  # fmt: skip
        return True

    def _step_by_kernel(self, kernels: ctypes.CDLL, live: dict[str, Tensor], lr: float, eps: float) -> bool:
        """The same in adam.cpp."""
        addresses, sizes, settings = [], [], []
        for name, parameter in live.items():
            count = float(self.steps[name]) + 1.0
            rate, root = lr / (1.0 - self.beta1**count), (1.0 - self.beta2**count) ** -0.5
            row = parameter.numel() // max(1, len(parameter)) if parameter.ndim else 1
            rows = parameter.numel() // max(1, row)
            for first, last, strength in self.decay.get(name, [(0, rows, 0.0)]):
                size = (last - first) * row
                for x in (parameter, parameter.grad, self.mean[name], self.square[name]):
                    addresses.append(x.data_ptr() + 4 * first * row)  # type: ignore[union-attr]
                sizes.append(size)
                settings += [strength / max(1, size), rate, root]
        broken = kernels.adam(
            (ctypes.c_void_p * len(addresses))(*addresses), (ctypes.c_int64 * len(sizes))(*sizes),
            (ctypes.c_double * len(settings))(*settings), ctypes.c_int(len(sizes)), ctypes.c_double(self.beta1),
            ctypes.c_double(self.beta2), ctypes.c_double(eps), ctypes.c_int(torch.get_num_threads()),
        )  # fmt: skip
        if broken:
            return False
        for name in live:
            self.steps[name] += 1
        return True

    def state(self) -> dict[str, Tensor]:
        """Moments and step counts, by flat name."""
        kinds = {"mean": self.mean, "square": self.square, "steps": self.steps}
        return {f"{kind}.{name}": value for kind, values in kinds.items() for name, value in values.items()}

    def load_state(self, state: dict[str, Tensor]) -> None:
        for name, target in self.state().items():
            target.copy_(state[name])
