"""Functions whose gradient is not that of their value, so that training stays finite or is steered."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

_LOG_DENSITY_MAX = 40.0  # e^40 * 1e6 is far below the float32 maximum: optical depths stay finite


class _SafeExp(torch.autograd.Function):
    """exp(min(x, 40)) whose gradient beyond the cap is that at the cap, so that no density gets stuck."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        y = x.clamp_max(_LOG_DENSITY_MAX).exp()
        ctx.save_for_backward(y)
        return y

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:  # type: ignore[override]
        return gradient * ctx.saved_tensors[0]


def safe_exp(x: Tensor) -> Tensor:
    """exp with value and gradient capped at e^40."""
    return _SafeExp.apply(x)  # type: ignore[no-any-return]


class _ScaleGradient(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, value: Tensor, scale: Tensor) -> Tensor:
        ctx.save_for_backward(scale)
        return value.view_as(value)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:  # type: ignore[override]
        return gradient * ctx.saved_tensors[0], None


def scale_gradient(value: Tensor, scale: Tensor) -> Tensor:
    """`value`, whose gradient is multiplied by `scale` (of its shape, or broadcast to it); `scale` gets none."""
    return _ScaleGradient.apply(value, scale)  # type: ignore[no-any-return]
