"""What happens along rays, by the fastest way there is: the C++ kernels of ray_intervals.cpp, or plain torch.

Each function has a reference in torch, here (`..._reference`) or in `stepfun`. The kernels are for float32 on the CPU
and rays of at most 128 intervals.
"""

from __future__ import annotations

import ctypes
from typing import Any

import torch
from torch import Tensor

from cat3d_core.cpu_library import library, pointer
from cat3d_core.zipnerf import stepfun

#: Most intervals of a ray that the kernels take.
MOST = 128


def kernels_for(*tensors: Tensor) -> ctypes.CDLL | None:
    """The kernels, if they take these tensors (R, n)."""
    for tensor in tensors:
        fits = tensor.dtype == torch.float32 and tensor.device.type == "cpu" and tensor.ndim == 2
        if not fits or not 2 <= tensor.shape[1] <= MOST:
            return None
    return library("zipnerf/ray_intervals")


def _call(kernel: Any, *arguments: Tensor | float, rays: int, counts: tuple[int, ...]) -> None:
    values = [pointer(x) if isinstance(x, Tensor) else ctypes.c_double(x) for x in arguments]
    kernel(*values, ctypes.c_int64(rays), *map(ctypes.c_int, counts), ctypes.c_int(torch.get_num_threads()))


def sample_intervals(t: Tensor, logits: Tensor, count: int, generator: torch.Generator | None = None) -> Tensor:
    """`stepfun.sample_intervals` for t (R, n+1) and logits (R, n), with the same random numbers."""
    kernels = kernels_for(t)
    if kernels is None or not 2 <= count <= MOST or logits.dtype != t.dtype:
        return stepfun.sample_intervals(t, logits, count, generator)
    u = stepfun.stratified(t, count, generator)
    t, logits, out = t.contiguous(), logits.contiguous(), t.new_empty((len(t), count + 1))
    stride = 0 if u.ndim == 1 else count
    _call(kernels.sample_intervals, t, logits, u, out, rays=len(t), counts=(stride, logits.shape[1], count))
    return out


def weights_reference(density: Tensor, lengths: Tensor) -> Tensor:
    """Compositing weights (R, n) = alpha * transmittance of intervals with these densities and lengths (R, n).

    alpha = -expm1(-optical depth): 1 - exp(-x) would lose thin fog (all of it at 1e-8) in float32.
    """
    depth = density * lengths
    before = torch.cat([torch.zeros_like(depth[..., :1]), depth[..., :-1].cumsum(-1)], -1)
    return -torch.expm1(-depth) * torch.exp(-before)


class _Weights(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, density: Tensor, lengths: Tensor) -> Tensor:
        density, lengths = density.contiguous(), lengths.contiguous()
        weights, behind = torch.empty_like(density), torch.empty_like(density)
        kernel = library("zipnerf/ray_intervals").weights_forward  # type: ignore[union-attr]
        _call(kernel, density, lengths, weights, behind, rays=len(density), counts=density.shape[1:])
        ctx.save_for_backward(lengths, weights, behind)
        return weights

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:  # type: ignore[override]
        lengths, weights, behind = ctx.saved_tensors
        out, gradient = torch.empty_like(weights), gradient.contiguous()
        kernel = library("zipnerf/ray_intervals").weights_backward  # type: ignore[union-attr]
        _call(kernel, gradient, lengths, weights, behind, out, rays=len(out), counts=out.shape[1:])
        return out, None


def weights(density: Tensor, lengths: Tensor) -> Tensor:
    """`weights_reference`; no gradient for the lengths."""
    if kernels_for(density, lengths) is None:
        return weights_reference(density, lengths.detach())
    return _Weights.apply(density, lengths)  # type: ignore[no-any-return]


def interlevel_reference(s: Tensor, weights: Tensor, t: Tensor, w: Tensor, halfwidth: float) -> Tensor:
    """Mean over rays and bins of max(0, target - weights)^2 / weights, the target the histogram (t, w) blurred and
    resampled in the bins s of the proposal (Zip-NeRF sec. 3).

    Gradient for `weights` only. eps keeps the denominator from zero: the slope is below 1 / eps^2 = 7e13 for a missed
    surface, finite, and falls with the proposal's own weight.
    """
    target = stepfun.blurred_resample(s, t, w, halfwidth)
    eps = torch.finfo(target.dtype).eps
    return ((target - weights).clamp_min(0.0).square() / (weights + eps)).mean()


class _WithSlope(torch.autograd.Function):
    """A value whose slope for `weights` is known already."""

    @staticmethod
    def forward(ctx: Any, weights: Tensor, value: Tensor, slope: Tensor) -> Tensor:
        ctx.save_for_backward(slope)
        return value

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:  # type: ignore[override]
        [slope] = ctx.saved_tensors
        return gradient[..., None] * slope if gradient.ndim else gradient * slope, None, None


def interlevel(s: Tensor, weights: Tensor, t: Tensor, w: Tensor, halfwidth: float) -> Tensor:
    """`interlevel_reference` of s (R, m+1), weights (R, m), t (R, n+1), w (R, n)."""
    kernels = kernels_for(s, weights, t, w)
    if kernels is None:
        return interlevel_reference(s, weights, t, w, halfwidth)
    inputs = [x.detach().contiguous() for x in (s, weights, t, w)]
    losses, slope = inputs[1].new_empty(len(s), dtype=torch.float64), torch.empty_like(inputs[1])
    counts = weights.shape[1], w.shape[1]
    _call(kernels.interlevel, *inputs, halfwidth, losses, slope, rays=len(s), counts=counts)
    value = (losses.sum() / weights.numel()).to(weights.dtype)
    return _WithSlope.apply(weights, value, slope.div_(weights.numel()))  # type: ignore[no-any-return]


def distortion(t: Tensor, w: Tensor) -> Tensor:
    """`stepfun.distortion` (R,) of t (R, n+1), w (R, n); gradient for w only."""
    kernels = kernels_for(t, w)
    if kernels is None:
        return stepfun.distortion(t.detach(), w)
    edges, inner = t.detach().contiguous(), w.detach().contiguous()
    value, slope = inner.new_empty(len(w)), torch.empty_like(inner)
    _call(kernels.distortion, edges, inner, value, slope, rays=len(w), counts=w.shape[1:])
    return _WithSlope.apply(w, value, slope)  # type: ignore[no-any-return]
