"""Losses of the reconstruction and the optimiser."""

from __future__ import annotations

import torch
from torch import Tensor

from cat3d_core.stress.draw import Draw
from cat3d_core.stress.routine import SINGLE, Exact, Routine, each
from cat3d_core.zipnerf import losses
from cat3d_core.zipnerf.adam import Adam
from cat3d_core.zipnerf.config import ZipNerfConfig
from cat3d_core.zipnerf.render import Round

_EPS = 1e-3
_CONFIG = ZipNerfConfig()
_HALFWIDTH = 0.02
_SINGLE_EPS = torch.finfo(torch.float32).eps


def _interlevel_inputs(draw: Draw) -> tuple[Tensor, ...]:
    """A proposal and a final histogram: agreeing, missing the surface, or empty."""
    weights = draw.magnitude(14, 1e-12, 0.1)
    empty = draw.unit(2) < 0.1
    proposal = torch.where(empty[:, :1], 0.0, weights[:, :6])
    final = torch.where(empty[:, 1:], 0.0, weights[:, 6:])
    return proposal, draw.edges(7), draw.edges(9, ties=False), final


def _interlevel(w: Tensor, s: Tensor, final_s: Tensor, final_w: Tensor) -> Tensor:
    proposal, final = Round(s[None], s[None], w[None]), Round(final_s[None], final_s[None], final_w[None])
    return losses.interlevel([proposal], final, (_HALFWIDTH,))


def _blurred(query: Tensor, t: Tensor, w: Tensor) -> Tensor:
    """Weight of the blurred histogram in each bin of `query`, as averages of the cumulative weight over windows."""
    width = t.diff(dim=-1)
    density = torch.where(width > 0, w / torch.where(width > 0, width, 1.0), 0.0)
    before = w.cumsum(-1) - w
    start, stop = t[:, None, :-1], t[:, None, 1:]
    low = (query - _HALFWIDTH)[..., None].clamp(start, stop)
    high = (query + _HALFWIDTH)[..., None].clamp(start, stop)
    inside = ((high - low) * (before[:, None] + density[:, None] * ((low + high) / 2 - start))).sum(-1)
    beyond = (query + _HALFWIDTH - torch.maximum(t[:, -1:], query - _HALFWIDTH)).clamp_min(0) * w.sum(-1, keepdim=True)
    return ((inside + beyond) / (2 * _HALFWIDTH)).diff(dim=-1).clamp_min(0)


def _interlevel_reference(w: Tensor, s: Tensor, final_s: Tensor, final_w: Tensor) -> Exact:
    target = _blurred(s, final_s, final_w)
    short = (target - w).clamp_min(0)
    value = (short * short / (w + _SINGLE_EPS)).mean(-1)
    # A weight rounds by eps of itself, and the blur by 1e-14 of the total: what is left of a difference is uncertain.
    noise = target + w + 1e-7 * final_w.sum(-1, keepdim=True)
    return Exact(value, ((short * noise + 1e-7 * noise * noise) / (w + _SINGLE_EPS)).mean(-1))


def _interlevel_slope(w: Tensor, s: Tensor, final_s: Tensor, final_w: Tensor) -> tuple[Tensor]:
    target = _blurred(s, final_s, final_w)
    return (((1 + (target + 1e-7) / (w + _SINGLE_EPS)) ** 2).amax(-1),)


def _distortion_inputs(draw: Draw) -> tuple[Tensor, ...]:
    return draw.edges(9) * draw.log_between(1, 1e-6, 1e12), draw.magnitude(8, 1e-12, 0.1)


def _distortion(t: Tensor, w: Tensor) -> Tensor:
    return losses.distortion(Round(t[None], t[None], w[None]), _CONFIG)


def _distortion_reference(t: Tensor, w: Tensor) -> Exact:
    """The double sum over the ladder 5 (1 - (1 + 8000 t)^(-1/4))."""
    c = 1 - _CONFIG.distortion_power
    far = (
        c
        / -_CONFIG.distortion_power
        * -torch.expm1(_CONFIG.distortion_power * torch.log1p(t * _CONFIG.distortion_premult / c))
    )
    width = far.diff(dim=-1)
    apart = (far[:, None, :-1] - far[:, 1:, None]) + (width[:, :, None] + width[:, None]) / 2
    value = 2 * (w[:, :, None] * w[:, None] * apart).triu(1).sum((1, 2)) + (w * w * width).sum(-1) / 3
    # The ladder rounds to eps of itself (it ends at 5), which is all that is left of thin intervals far away.
    total = w.sum(-1)
    return Exact(value, (value + far[:, -1] * total * total).detach())


def _depth_inputs(draw: Draw) -> tuple[Tensor, ...]:
    """A histogram from the camera to far away, thin intervals included, and an inverse depth at any place."""
    t = draw.edges(9) * draw.log_between(1, 1e-6, 1e6)
    return t, draw.magnitude(8, 1e-12, 0.1), draw.log_between(1, 1e-6, 1e2), draw.unit(1)


def _depth(t: Tensor, w: Tensor, target: Tensor, weight: Tensor) -> Tensor:
    return losses.inverse_depth(Round(t[None], t[None], w[None]), target, weight)


def _depth_slope(t: Tensor, w: Tensor, target: Tensor, weight: Tensor) -> tuple[Tensor]:
    """Where the two inverse depths nearly agree, their rounding decides the slope of the Charbonnier distance."""
    rendered = (2 * w / (t[:, 1:] + t[:, :-1]).clamp_min(2 * losses.NEAREST)).sum(-1)
    noise = 1 + (rendered + target[:, 0]) / _EPS
    return (weight[:, 0] * noise * (2 / (t[:, 1:] + t[:, :-1]).clamp_min(2 * losses.NEAREST)).amax(-1),)


def _depth_reference(t: Tensor, w: Tensor, target: Tensor, weight: Tensor) -> Exact:
    """Twice the weight over the sum of the edges; what two inverse depths nearly have in common cancels."""
    rendered = (2 * w / (t[:, 1:] + t[:, :-1]).clamp_min(2 * losses.NEAREST)).sum(-1)
    target, weight = target[:, 0], weight[:, 0]
    return Exact(weight * torch.hypot(rendered - target, torch.tensor(_EPS)), weight * (rendered + target + _EPS))


def _trust_inputs(draw: Draw) -> tuple[Tensor, ...]:
    return draw.signed(9).view(-1, 3, 3), draw.unit(1)


def _trust(centers: Tensor, progress: Tensor) -> Tensor:
    return losses.view_weights(centers, torch.tensor([True, False, False]), _CONFIG, float(progress))


def _trust_reference(centers: Tensor, progress: Tensor) -> Exact:
    shift = (centers - centers[:, :1]).square().sum(-1) * _CONFIG.distance_falloff * progress
    overall = 1 + progress * (_CONFIG.generated_weight_final - 1)
    value = torch.exp(-shift) * torch.where(torch.tensor([True, False, False]), 1.0, overall)
    rounding = centers.abs().sum((1, 2))[:, None] ** 2 * _CONFIG.distance_falloff * progress
    return Exact(value, value * (1 + rounding) + 1e-30)


_LR, _BETA1, _BETA2, _TINY = 0.01, 0.9, 0.99, 1e-15
_DECAY = 0.1


def _adam_inputs(draw: Draw) -> tuple[Tensor, ...]:
    """A parameter and four gradients of it, of any magnitude (the optimiser squares them)."""
    return draw.signed(1, 1e-6, 1e3), draw.signed(4) * draw.magnitude(1, 1e-6, 1e6, special=False)


def _adam(start: Tensor, gradients: Tensor) -> Tensor:
    """How far each parameter has moved after each of four steps, in learning rates."""
    parameter = start[:, 0].clone().requires_grad_()
    adam = Adam({"x": parameter}, {}, _BETA1, _BETA2, _TINY)
    moved = []
    for gradient in gradients.unbind(1):
        with torch.no_grad():
            parameter.zero_()  # from zero, so that the step itself is seen and not its rounding into the parameter
        parameter.grad = gradient.clone()
        adam.step(_LR)
        moved.append(parameter.detach().clone() / _LR)
    return torch.stack(moved, 1)


def _adam_reference(start: Tensor, gradients: Tensor) -> Exact:
    """Adam as in its paper; the moments as sums of powers, not by recurrence."""
    steps = torch.arange(4, dtype=torch.float64)
    age = steps[:, None] - steps[None]
    first = torch.where(age >= 0, (1 - _BETA1) * _BETA1**age, 0.0) / (1 - _BETA1 ** (steps + 1))[:, None]
    second = torch.where(age >= 0, (1 - _BETA2) * _BETA2**age, 0.0) / (1 - _BETA2 ** (steps + 1))[:, None]
    size = (gradients.square() @ second.T).sqrt() + _TINY
    return Exact(-(gradients @ first.T) / size, (gradients.abs() @ first.T) / size)


def _decay_inputs(draw: Draw) -> tuple[Tensor, ...]:
    return (draw.signed(8).view(-1, 8, 1),)


def _decay(rows: Tensor) -> Tensor:
    """The decay's share of the gradient, over two groups of rows; gradients are zero otherwise. Read off the first
    moment, a tenth of it: below 1e-36 that is no normal number any more."""
    parameter = rows.clone().requires_grad_()
    parameter.grad = torch.zeros_like(rows)
    adam = Adam({"x": parameter}, {"x": [(0, 3, _DECAY), (3, 8, 2 * _DECAY)]}, _BETA1, _BETA2, _TINY)
    adam.step(_LR)
    return adam.mean["x"] / (1 - _BETA1)


def _decay_reference(rows: Tensor) -> Tensor:
    return torch.cat([rows[:, :3] * (_DECAY / 3), rows[:, 3:] * (2 * _DECAY / 5)], 1)


ROUTINES = [
    Routine(
        "losses.charbonnier", "sqrt(d^2 + eps^2) with its slope, d = 0 and 1e12 included",
        lambda draw: (draw.signed(1)[:, 0],), lambda d: losses.charbonnier(d, _EPS),
        lambda d: _EPS * torch.cosh(torch.asinh(d / _EPS)), {SINGLE: 5e-7}, {SINGLE: 1e-6},
    ),
    Routine(
        "losses.interlevel", "spline inter-level loss, missed surfaces and empty rays included",
        _interlevel_inputs, each(_interlevel), _interlevel_reference, {SINGLE: 2e-6}, {SINGLE: 2e-6}, share=0.1,
        gradient_scale=_interlevel_slope,
    ),
    Routine(
        "losses.distortion", "over ladder distance up to 1e12", _distortion_inputs, each(_distortion),
        _distortion_reference, {SINGLE: 1e-6}, share=0.1,
    ),
    Routine(
        "losses.inverse_depth", "known inverse depths from 1e-6 to 100, with the slope by the weights",
        _depth_inputs, each(_depth), _depth_reference, {SINGLE: 2e-6}, {SINGLE: 2e-6}, share=0.1, wrt=(1,),
        gradient_scale=_depth_slope,
    ),
    Routine(
        "losses.view_weights", "weights of generated views at any distance", _trust_inputs, each(_trust),
        _trust_reference, {SINGLE: 2e-6}, share=0.1,
    ),
    Routine(
        "adam.Adam", "four steps, gradients from 1e-18 to 1e18", _adam_inputs, _adam, _adam_reference, {SINGLE: 2e-6},
        floor=1e-20,
    ),
    Routine(
        "adam.Adam[decay]", "normalised decay of groups of rows", _decay_inputs, each(_decay), _decay_reference,
        {SINGLE: 2e-7}, share=0.1, floor=1e-36,
    ),
]  # fmt: skip
