"""Attention, the autoencoder and the time embedding, in every precision they run in."""

from __future__ import annotations

import copy
import math

import torch
from torch import Tensor

from cat3d_core.diffusion.attention import Attention, fold_views, unfold_views
from cat3d_core.diffusion.autoencoder import Autoencoder
from cat3d_core.diffusion.config import AutoencoderConfig
from cat3d_core.diffusion.layers import time_embedding
from cat3d_core.stress.draw import Draw
from cat3d_core.stress.routine import BRAIN, DOUBLE, HALF, ROUNDING, SINGLE, Exact, Routine, zero

_CHANNELS, _HEADS, _TOKENS = 8, 2, 6


def _attention(dtype: torch.dtype) -> Attention:
    module = Attention(_CHANNELS, _HEADS).requires_grad_(False)
    generator = torch.Generator().manual_seed(0)
    for parameter in module.parameters():
        # Half precision can hold these weights, so that every dtype has the same network.
        parameter.copy_(torch.randn(parameter.shape, generator=generator).div(_CHANNELS**0.5).bfloat16().float())
    return module.to(dtype)


_ATTENTION = {dtype: _attention(dtype) for dtype in (DOUBLE, SINGLE, HALF, BRAIN)}


def _token_inputs(draw: Draw) -> tuple[Tensor, ...]:
    """Tokens of size 1e-3 to 30, some equal, some zero, some one-hot: even and wholly decided attention."""
    tokens = draw.normal(_TOKENS * _CHANNELS).view(-1, _TOKENS, _CHANNELS) * draw.log_between(1, 1e-3, 30.0)[..., None]
    kind = draw.unit(1)[..., None]
    tokens = torch.where(kind < 0.1, tokens[:, :1], torch.where(kind < 0.2, 0.0, tokens))
    return (torch.where((draw.unit(_TOKENS) < 0.1)[..., None], 0.0, tokens),)


def _attention_reference(tokens: Tensor) -> Exact:
    """softmax(Q K^T / sqrt(d)) V, head by head."""
    module = _ATTENTION[DOUBLE]
    q, k, v = (tokens @ layer.weight.T for layer in (module.to_q, module.to_k, module.to_v))
    width = _CHANNELS // _HEADS
    parts, sharpest = [], torch.zeros(len(tokens), dtype=torch.float64)
    for head in range(_HEADS):
        part = slice(head * width, (head + 1) * width)
        logits = q[..., part] @ k[..., part].transpose(1, 2) / width**0.5
        parts.append(torch.exp(logits - logits.logsumexp(-1, keepdim=True)) @ v[..., part])
        size = q[..., part].norm(dim=-1).amax(-1) * k[..., part].norm(dim=-1).amax(-1) / width**0.5
        sharpest = torch.maximum(sharpest, size.detach())
    value = torch.cat(parts, -1) @ module.to_out[0].weight.T + module.to_out[0].bias  # type: ignore[operator]
    # A logit of size L is known to L eps, and so is the weight it becomes.
    return Exact(value, ((1 + v.detach().abs().amax((1, 2))) * (1 + sharpest))[:, None, None])


def _attention_slope(tokens: Tensor) -> tuple[Tensor]:
    size = tokens.norm(dim=-1).amax(-1)
    return ((1 + size * size) ** 2,)


def _folded(tokens: Tensor) -> Tensor:
    """Number of entries that folding views and unfolding them again moves, in the two ways of joining."""
    total = torch.zeros(len(tokens), dtype=torch.float64)
    for mode in ("3d", "temporal"):
        doubled = torch.stack([tokens, -tokens], 1).flatten(0, 1)
        there = fold_views(doubled, 2, mode)
        back = unfold_views(there, 2, tokens.shape[1], mode)
        total = total + (back != doubled).unflatten(0, (-1, 2)).flatten(1).sum(1)
    return total.to(tokens.dtype)


_CONFIG = AutoencoderConfig(latent_channels=4, widths=(8, 8, 16), blocks=(1, 1, 1), norm_groups=4)


def _autoencoder() -> Autoencoder:
    module = Autoencoder(_CONFIG).requires_grad_(False).eval()
    generator = torch.Generator().manual_seed(0)
    for parameter in module.parameters():
        scale = parameter[0].numel() ** -0.5 if parameter.dim() > 1 else 0.3
        parameter.copy_((torch.randn(parameter.shape, generator=generator) * scale).bfloat16().float())
    return module


_AUTOENCODERS = {dtype: copy.deepcopy(_autoencoder()).to(dtype) for dtype in (DOUBLE, SINGLE, HALF, BRAIN)}


def _image_inputs(draw: Draw) -> tuple[Tensor, ...]:
    """Black, white, one colour, nearly one colour, noise."""
    noise = draw.unit(3 * 256).view(-1, 3, 16, 16)
    level = torch.where(draw.unit(1) < 0.5, draw.choice(0.0, 1.0), draw.unit(1))[..., None, None]
    kind = draw.unit(1)[..., None, None]
    near = (level + (noise - 0.5) * draw.log_between(1, 1e-6, 1e-1)[..., None, None]).clamp(0, 1)
    return (torch.where(kind < 0.4, noise, torch.where(kind < 0.7, near, level)),)


def _encode(images: Tensor) -> Tensor:
    # (torch's pixel unshuffle does not know an empty batch; `posterior` refuses it.)
    return _AUTOENCODERS[images.dtype].encode(images) if len(images) else images


def _encode_reference(images: Tensor) -> Exact:
    value = _AUTOENCODERS[DOUBLE].encode(images) if len(images) else images
    return Exact(value, torch.ones_like(value))


def _decode(latents: Tensor) -> Tensor:
    return _AUTOENCODERS[latents.dtype].decode(latents)


def _decode_reference(latents: Tensor) -> Exact:
    value = (_AUTOENCODERS[DOUBLE].decode_raw(latents)).clamp(0, 1)
    return Exact(value, torch.ones_like(value))


def _embedding_reference(time: Tensor) -> Exact:
    k = torch.arange(16, dtype=torch.float64)
    angle = time[:, None] * 10000.0 ** (-k / 16)
    value = torch.cat([torch.sin(angle + math.pi / 2), torch.sin(angle)], -1)
    return Exact(value, 1 + angle.abs().repeat(1, 2))


def _one(images: Tensor) -> tuple[Tensor]:
    return (torch.ones(len(images), dtype=torch.float64),)


ROUTINES = [
    Routine(
        "attention.Attention", "even and wholly decided attention, value and gradient",
        _token_inputs, lambda x: _ATTENTION[x.dtype](x), _attention_reference,
        {DOUBLE: 4e-15, SINGLE: 2e-6, HALF: 2e-3, BRAIN: 2e-2}, ROUNDING, share=0.5, chunk=1024,
        gradient_scale=_attention_slope,
    ),
    Routine(
        "attention.fold_views", "a permutation, undone exactly",
        _token_inputs, _folded, zero, {DOUBLE: 0.0, SINGLE: 0.0, HALF: 0.0, BRAIN: 0.0}, share=0.1,
    ),
    Routine(
        "autoencoder.encode", "black, white, one colour and noise", _image_inputs, _encode, _encode_reference,
        {SINGLE: 4e-6, HALF: 4e-3, BRAIN: 3e-2}, {SINGLE: 1e-5}, share=0.02, chunk=64, gradient_scale=_one,
    ),
    Routine(
        "autoencoder.decode", "latents from nothing to 1e3",
        lambda draw: (draw.signed(16, 1e-6, 1e3).view(-1, 4, 2, 2),), _decode, _decode_reference,
        {SINGLE: 4e-6, HALF: 4e-3, BRAIN: 3e-2}, share=0.02, chunk=64,
    ),
    Routine(
        "layers.time_embedding", "fractional steps up to 1000", lambda draw: (draw.between(1, 0, 1000)[:, 0],),
        lambda t: time_embedding(t, 32), _embedding_reference, {SINGLE: 1e-6},
    ),
]  # fmt: skip
