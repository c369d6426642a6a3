"""Image, depth and surface metrics."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from cat3d_core.metrics.depth import depth_errors
from cat3d_core.metrics.geometry import nearest_distances
from cat3d_core.metrics.perceptual import PerceptualDistance
from cat3d_core.metrics.psnr import average_error, mean_squared_error, psnr
from cat3d_core.metrics.ssim import WINDOWS, ssim, ssim_map
from cat3d_core.stress.draw import Draw
from cat3d_core.stress.routine import (
    BRAIN,
    DOUBLE,
    HALF,
    ROUNDING,
    SINGLE,
    Call,
    Exact,
    Inputs,
    Reference,
    Routine,
    each,
    zero,
)


def _pair(side: int) -> Inputs:
    """Two images in [0, 1]: black, white, grey, noise, or smooth; unlike by anything from nothing to everything."""

    def inputs(draw: Draw) -> tuple[Tensor, ...]:
        shape = (draw.count, 3, side, side)
        noise = draw.unit(3 * side * side).view(shape)
        flat = draw.choice(0.0, 1.0, 0.5)[..., None, None]
        level = draw.unit(1)[..., None, None]
        kind = draw.unit(1)[..., None, None]
        rough = torch.where(kind < 0.8, noise, level * noise)
        image = torch.where(kind < 0.3, flat, torch.where(kind < 0.5, level, rough))
        change = draw.signed(3 * side * side, 1e-12, 1.0).view(shape)
        size = draw.magnitude(1, 1e-12, 1.0)[..., None, None]
        kind = draw.unit(1)[..., None, None]
        change = torch.where(kind < 0.15, 0.0, torch.where(kind < 0.6, size * change.sign(), size * change))
        # Squares of differences below 1e-15 are not all float32 numbers (mean_squared_error says so).
        change = torch.where(change.abs() < 1e-15, 0.0, change)
        other = (image + change).clamp(0, 1)
        return image.expand(shape).contiguous(), other

    return inputs


def _mse_reference(x: Tensor, y: Tensor) -> Exact:
    value = (x - y).square().flatten(1).sum(1) / x[0].numel() if len(x) else x.new_zeros(0)
    # float32 squares differences, so those below 1e-19 are nothing (documented: 1e-22 at most).
    return Exact(value, value.detach() + 1e-37)


def _psnr_reference(x: Tensor, y: Tensor) -> Exact:
    mse = _mse_reference(x, y).value
    same = mse == 0
    decibels = -10 * torch.log(torch.where(same, 1.0, mse)) / torch.log(torch.tensor(10.0, dtype=torch.float64))
    # 4.3 dB are a factor of e: the error in dB is that of the mean square.
    return Exact(torch.where(same, torch.inf, decibels), torch.full_like(decibels, 10.0) + decibels.detach().abs())


def _whole(measure: Call) -> Call:
    """A metric that refuses an empty batch, here with no cases."""
    return lambda x, y: measure(x, y) if len(x) else x.new_zeros(0)


def _ssim_reference(window: str) -> Reference:
    """The textbook formula, with means and covariances by two passes over every window."""
    taps = torch.tensor(WINDOWS[window].taps, dtype=torch.float64)
    size = len(taps)
    weight = torch.outer(taps, taps).flatten()
    scale = size**2 / (size**2 - 1) if WINDOWS[window].bessel else 1.0

    def exact(x: Tensor, y: Tensor) -> Exact:
        if not len(x):
            return Exact(x.new_zeros(0), x.new_zeros(0))
        pad = size // 2 if WINDOWS[window].zero_padded else 0
        a, b = (F.unfold(F.pad(z, (pad,) * 4), size).unflatten(1, (3, size * size)) for z in (x, y))
        w = weight[:, None]
        mean_a, mean_b = (w * a).sum(2, keepdim=True), (w * b).sum(2, keepdim=True)
        a, b = a - mean_a, b - mean_b
        mean_a, mean_b = mean_a[:, :, 0], mean_b[:, :, 0]
        var_a, var_b, cov = (scale * (w * p).sum(2) for p in (a * a, b * b, a * b))
        c1, c2 = 1e-4, 9e-4
        top = (2 * mean_a * mean_b + c1) * (2 * cov + c2)
        local = top / ((mean_a**2 + mean_b**2 + c1) * (var_a + var_b + c2))
        value = local.mean((1, 2))
        return Exact(value, torch.ones_like(value))

    return exact


def _never_above_one(x: Tensor, y: Tensor) -> Tensor:
    """By how much a local SSIM leaves [-1, 1], plus the error of identical images."""
    if not len(x):
        return x.new_zeros(0)
    local = ssim_map(x, y).flatten(1)
    outside = (local.amax(1) - 1).clamp_min(0) + (-1 - local.amin(1)).clamp_min(0)
    return outside + (ssim(x, x) - 1).abs()


_PERCEPTUAL: dict[torch.dtype, PerceptualDistance] = {}


def _perceptual(dtype: torch.dtype) -> PerceptualDistance:
    """A squeeze network with fixed random weights (no file of weights is needed for numerics)."""
    if dtype not in _PERCEPTUAL:
        network = PerceptualDistance("lpips-squeeze")
        generator = torch.Generator().manual_seed(0)
        for parameter in network.features.parameters():
            bound = (6 / parameter[0].numel()) ** 0.5 if parameter.dim() > 1 else 0.1
            parameter.copy_(torch.empty(parameter.shape).uniform_(-bound, bound, generator=generator))
        _PERCEPTUAL[dtype] = network.to(dtype)
    return _PERCEPTUAL[dtype]


def _lpips(x: Tensor, y: Tensor) -> Tensor:
    return _perceptual(torch.promote_types(x.dtype, torch.float32))(x, y) if len(x) else x.new_zeros(0)


def _lpips_reference(x: Tensor, y: Tensor) -> Exact:
    value = _perceptual(torch.float64)(x, y) if len(x) else x.new_zeros(0)
    return Exact(value, value.detach() + 1e-4)  # differences of unit vectors cancel: their square is known to eps


def _average_inputs(draw: Draw) -> tuple[Tensor, ...]:
    return draw.between(1, 0, 120)[:, 0], draw.between(1, -1, 1)[:, 0], draw.log_between(1, 1e-12, 1.0)[:, 0]


def _average_reference(p: Tensor, s: Tensor, lp: Tensor) -> Exact:
    mse = torch.exp(-p * (torch.log(torch.tensor(10.0, dtype=torch.float64)) / 10))
    value = torch.exp((mse.log() + (1 - s).log() / 2 + lp.log()) / 3)
    return Exact(value, value * (1 + p / 10 + 1 / (1 - s)))


def _depth_inputs(draw: Draw) -> tuple[Tensor, ...]:
    truth = draw.magnitude(12, 1e-12, 1e12)
    truth[:, 0:1] = draw.log_between(1, 1e-12, 1e12)  # one pixel at least is known
    return (truth.clamp_min(0) * draw.log_between(12, 0.5, 2.0)).view(-1, 3, 4), truth.view(-1, 3, 4)


def _depth(p: Tensor, t: Tensor) -> Tensor:
    errors = depth_errors(p[None], t[None])
    return torch.stack([errors["abs_rel"][0], errors["rmse"][0]])


def _depth_reference(p: Tensor, t: Tensor) -> Exact:
    known = (t > 0).double()
    count = known.sum((1, 2))
    share = ((p / torch.where(t > 0, t, 1.0) - 1).abs() * known).sum((1, 2)) / count
    biggest = ((p - t).abs() * known).amax((1, 2))
    unit = torch.where(biggest > 0, biggest, 1.0)
    rmse = unit * ((((p - t) / unit[:, None, None]).square() * known).sum((1, 2)) / count).sqrt()
    value = torch.stack([share, rmse], 1)
    return Exact(value, value.abs() + torch.stack([torch.ones_like(rmse), biggest], 1))


def _cloud_inputs(draw: Draw) -> tuple[Tensor, ...]:
    base = draw.signed(3)[:, None]
    return base + draw.signed(12, 1e-6, 1e6).view(-1, 4, 3), base + draw.signed(9, 1e-6, 1e6).view(-1, 3, 3)


def _nearest_reference(points: Tensor, reference: Tensor) -> Tensor:
    offset = points[:, :, None] - reference[:, None]
    unit = offset.abs().amax(-1).clamp_min(1e-300)
    return (unit * (offset / unit[..., None]).square().sum(-1).sqrt()).amin(-1)


def _ssim_rows() -> list[Routine]:
    return [
        Routine(
            f"ssim.ssim[{window}]", "SSIM as in the textbook, float64 inside, value and gradient",
            _pair(12), _whole(lambda x, y, w=window: ssim(x, y, w)), _ssim_reference(window),
            {DOUBLE: 2e-14, SINGLE: 2e-14, HALF: 2e-14, BRAIN: 2e-14}, {DOUBLE: 2e-14, SINGLE: 1e-6},
            share=0.02, chunk=256, gradient_scale=lambda x, y: (torch.ones(len(x), dtype=torch.float64),),
        )
        for window in WINDOWS
    ]  # fmt: skip


ROUTINES = [
    Routine(
        "psnr.mean_squared_error", "any difference from 1e-12 to 1",
        _pair(4), _whole(mean_squared_error), _mse_reference, {DOUBLE: 4e-15, SINGLE: 1e-6, HALF: 1e-6, BRAIN: 1e-6},
        ROUNDING,
    ),
    Routine(
        "psnr.psnr", "identical images have +inf and no gradient",
        _pair(4), _whole(psnr), _psnr_reference, {DOUBLE: 4e-15, SINGLE: 1e-6, HALF: 1e-6, BRAIN: 1e-6},
        {DOUBLE: 4e-15, SINGLE: 4e-6},
    ),
    *_ssim_rows(),
    Routine(
        "ssim.ssim_map", "never outside [-1, 1], exactly 1 for identical images",
        _pair(12), _never_above_one, zero, {DOUBLE: 0.0, SINGLE: 0.0, HALF: 0.0, BRAIN: 0.0}, share=0.1, chunk=256,
    ),
    Routine(
        "perceptual.PerceptualDistance", "black, white and identical images; the slope's size (pooling may move it)",
        _pair(32), _lpips, _lpips_reference, {SINGLE: 1e-4, HALF: 1e-4, BRAIN: 1e-4}, {SINGLE: 4.0}, share=0.003,
        chunk=16, floor=1e-3,
    ),
    Routine(
        "psnr.average_error", "geometric mean of three errors", _average_inputs, average_error, _average_reference,
        ROUNDING,
    ),
    Routine(
        "depth.depth_errors", "relative and rms error of depths from 1e-12 to 1e12",
        _depth_inputs, each(_depth), _depth_reference, {DOUBLE: 4e-15, SINGLE: 4e-15}, share=0.1,
    ),
    Routine(
        "geometry.nearest_distances", "distances of points far from the origin",
        _cloud_inputs, each(nearest_distances), _nearest_reference, ROUNDING, share=0.1,
        floor=1e-15,
    ),
]  # fmt: skip
