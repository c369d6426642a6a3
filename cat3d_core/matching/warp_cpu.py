"""Gathering and pooling of `targets.py` as small C++ kernels (warp.cpp), float32 on the CPU."""

from __future__ import annotations

import ctypes
import math
from typing import Any

import torch
from torch import Tensor

from cat3d_core.cpu_library import library, pointer
from cat3d_core.matching.planes import SCALE
from cat3d_core.matching.warp import Maps

_NAME = "matching/warp"
_EVIDENCE = 8


def available(tensor: Tensor) -> bool:
    """Whether the kernels are there for such tensors; compiles them at the first call, warns once where that fails."""
    return tensor.device.type == "cpu" and library(_NAME) is not None


def _integers(*values: int) -> Any:
    return (ctypes.c_int64 * len(values))(*values)


class _Gather(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, features: Tensor, own: Tensor, photos: Tensor, maps: tuple[Tensor, Tensor, Tensor], depth: Tensor,
        nearest: float,
    ) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
        n, m = photos.shape
        k, height, width = depth.shape[1:]
        _, map_height, map_width, channels = features.shape
        ctx.sizes = (n, m, k, height, width, channels, map_height, map_width, *own.shape[1:3])
        ctx.rates = (math.log1p(nearest / SCALE), SCALE)
        voxels = features.new_empty(n, m, k, height, width, channels + _EVIDENCE)
        valid, agreement = (features.new_empty(n, m, k, height, width) for _ in range(2))
        inputs = (features, own, photos, *maps, depth)
        ctx.save_for_backward(*inputs)
        _gather(ctx, inputs, (voxels, valid, agreement), (None,) * 4)
        ctx.mark_non_differentiable(valid)
        return voxels, valid, agreement

    @staticmethod
    def backward(ctx: Any, voxels: Tensor, _: Tensor, agreement: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        features, own = ctx.saved_tensors[:2]
        gradients = torch.zeros_like(features), torch.zeros_like(own)
        _gather(ctx, ctx.saved_tensors, (None,) * 3, (voxels.contiguous(), agreement.contiguous(), *gradients))
        return *gradients, None, None, None, None


def _gather(
    ctx: Any, inputs: tuple[Tensor, ...], out: tuple[Tensor | None, ...], back: tuple[Tensor | None, ...]
) -> None:
    kernels = library(_NAME)
    assert kernels is not None
    kernels.gather(
        _integers(*ctx.sizes), (ctypes.c_float * 2)(*ctx.rates), *(pointer(t) for t in (*inputs, *out, *back)),
        ctypes.c_int(torch.get_num_threads()),
    )  # fmt: skip


def gather(
    features: Tensor, own: Tensor, photos: Tensor, maps: Maps, depth: Tensor, nearest: float
) -> tuple[Tensor, Tensor, Tensor]:
    """As `targets.gather_reference`: voxels, valid and agreement. Gradients for features and own only.

    features (B, C, h', w'); own (B, 2, h'', w''): position and log_spread; photos (N, M); depth (N, K, h, w)."""
    flat = (maps.turn.reshape(-1, 9), maps.shift, maps.baseline)
    return _Gather.apply(  # type: ignore[no-any-return]
        features.float().permute(0, 2, 3, 1).contiguous(), own.float().permute(0, 2, 3, 1).contiguous(),
        photos.long().contiguous(), tuple(t.detach().float().contiguous() for t in flat),
        depth.detach().float().contiguous(), nearest,
    )  # fmt: skip


class _Pool(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, hidden: Tensor, valid: Tensor) -> Tensor:
        n, m, voxels, row = hidden.shape
        out = hidden.new_empty(n, voxels, 2 * row)
        ctx.save_for_backward(hidden, valid)
        _pool(hidden, valid, out, None, None)
        return out

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:  # type: ignore[override]
        hidden, valid = ctx.saved_tensors
        out = torch.empty_like(hidden)
        _pool(hidden, valid, None, gradient.contiguous(), out)
        return out, None


def _pool(hidden: Tensor, valid: Tensor, out: Tensor | None, gradient: Tensor | None, back: Tensor | None) -> None:
    kernels = library(_NAME)
    assert kernels is not None
    n, m, voxels, row = hidden.shape
    kernels.pool(
        _integers(n, m, voxels, row - 1), *(pointer(t) for t in (hidden, valid, out, gradient, back)),
        ctypes.c_int(torch.get_num_threads()),
    )  # fmt: skip


def pool(hidden: Tensor, valid: Tensor) -> Tensor:
    """As `targets.pool_reference`: hidden (N, M, ..., C + 1), valid (N, M, ...) -> (N, ..., 2 C + 2)."""
    n, row = hidden.shape[0], hidden.shape[-1]
    out = _Pool.apply(hidden.float().flatten(2, -2).contiguous(), valid.flatten(2).contiguous())
    return out.reshape(n, *hidden.shape[2:-1], 2 * row)  # type: ignore[no-any-return]
