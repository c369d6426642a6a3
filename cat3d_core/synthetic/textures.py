"""Tileable procedural textures, crops of photographs, and their mip pyramid."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

PATTERNS = ("noise", "checker", "stripes", "bricks", "spots", "marble", "patchwork", "plain", "grid")


def random_colour(generator: torch.Generator) -> Tensor:
    """(3,) a colour of random hue; saturation and value favour what photographs hold (muted, mid-bright)."""
    hue, saturation, value = torch.rand(3, generator=generator).tolist()
    saturation, value = 0.9 * saturation**1.3, 0.2 + 0.8 * value
    phase = torch.tensor([0.0, 1 / 3, 2 / 3])
    ramp = ((hue + phase) % 1 * 6 - 3).abs().sub(1).clamp(0, 1)
    return value * (1 - saturation + saturation * ramp)


def spectral_noise(size: int, slope: float, generator: torch.Generator) -> Tensor:
    """(size, size) tileable noise whose amplitude falls as frequency^-slope, scaled to [0, 1]."""
    spectrum = torch.fft.rfft2(torch.randn(size, size, generator=generator))
    fy = torch.fft.fftfreq(size)[:, None] * size
    fx = torch.fft.rfftfreq(size)[None] * size
    radius = (fx.square() + fy.square()).sqrt().clamp(min=1)
    image = torch.fft.irfft2(spectrum * radius**-slope, s=(size, size))
    return (image - image.min()) / (image.max() - image.min()).clamp(min=1e-6)


def _pattern_value(name: str, size: int, generator: torch.Generator) -> Tensor:
    """(size, size) scalar pattern in [0, 1], tileable."""
    v, u = torch.meshgrid(torch.arange(size) / size, torch.arange(size) / size, indexing="ij")

    def integer(low: int, high: int) -> int:
        return int(torch.randint(low, high, (), generator=generator))

    slope = 0.9 + 1.3 * torch.rand((), generator=generator).item()
    if name == "noise":
        return spectral_noise(size, slope, generator)
    if name == "checker":
        n = 2 * integer(1, 4)
        return (((u * n).floor() + (v * n).floor()) % 2).float()
    if name == "stripes":
        wave = (integer(0, 5) * u + integer(1, 6) * v) * 2 * math.pi
        return 0.5 + 0.5 * torch.sin(wave).mul(4).clamp(-1, 1)
    if name == "bricks":
        rows, columns = 2 * integer(2, 5), integer(2, 5)
        shifted = u * columns + 0.5 * ((v * rows).floor() % 2)
        mortar = ((v * rows) % 1 < 0.14) | (shifted % 1 < 0.08)
        shade = torch.rand(rows, columns, generator=generator)
        cell = shade[(v * rows).long(), shifted.long() % columns]
        return torch.where(mortar, torch.ones_like(u), 0.6 * cell)
    if name == "spots":
        centres = torch.rand(integer(4, 16), 2, generator=generator)
        offset = (torch.stack([u, v], -1)[:, :, None] - centres + 0.5) % 1 - 0.5
        distance, nearest = offset.norm(dim=-1).min(-1)
        radius = 0.05 + 0.12 * torch.rand(len(centres), generator=generator)
        return (distance < radius[nearest]).float() * (0.5 + 0.5 * (nearest % 3) / 2)
    if name == "marble":
        warp = spectral_noise(size, 1.8, generator) * (1 + 3 * torch.rand((), generator=generator))
        return 0.5 + 0.5 * torch.sin(2 * math.pi * (integer(0, 3) * u + integer(1, 5) * v + warp))
    if name == "patchwork":
        rows, columns = integer(2, 7), integer(2, 7)
        return torch.rand(rows, columns, generator=generator)[(v * rows).long(), (u * columns).long()]
    if name == "grid":
        n = integer(2, 7)
        return (((u * n) % 1 < 0.12) | ((v * n) % 1 < 0.12)).float()
    return torch.full((size, size), 0.5)


def procedural_texture(size: int, generator: torch.Generator) -> Tensor:
    """(3, size, size) a random tileable pattern, coloured through a palette of three colours, with some grain."""
    name = PATTERNS[int(torch.randint(len(PATTERNS), (), generator=generator))]
    value = _pattern_value(name, size, generator)
    palette = torch.stack([random_colour(generator) for _ in range(3)])
    x = value.clamp(0, 1) * 2
    low = palette[0] + (palette[1] - palette[0]) * x.clamp(max=1)[..., None]
    colour = low + (palette[2] - palette[1]) * (x - 1).clamp(min=0)[..., None]
    grain = spectral_noise(size, 1.0, generator) - 0.5
    strength = 0.5 * torch.rand((), generator=generator)
    return (colour.permute(2, 0, 1) * (1 + strength * grain)).clamp(0, 1)


def photo_texture(photos: Tensor, size: int, generator: torch.Generator) -> Tensor:
    """(3, size, size) a random square window of one photograph, resampled.

    photos (M, 3, H, W) in [0, 1]. Photographs don't tile: the sampler mirrors every other repeat instead.
    """
    count, _, height, width = photos.shape
    pick = int(torch.randint(count, (), generator=generator))
    share, fy, fx = torch.rand(3, generator=generator).tolist()
    side = max(min(height, width, size // 2), int((0.25 + 0.75 * share) * min(height, width)))
    top, left = int(fy * (height - side)), int(fx * (width - side))
    window = photos[pick : pick + 1, :, top : top + side, left : left + side].float()
    if int(torch.randint(2, (), generator=generator)):
        window = window.flip(-1)
    return F.interpolate(window, (size, size), mode="bilinear", antialias=True, align_corners=False)[0].clamp(0, 1)


class Pyramid(NamedTuple):
    """All mip levels of many textures: table (S * T * texels, 3), one texture's texels contiguous, level by level;
    first (L,): the first texel of each level; side (L,): texels along each level's edge."""

    table: Tensor
    first: Tensor
    side: Tensor


def texture_pyramid(textures: Tensor) -> Pyramid:
    """Mip levels of textures (S, T, 3, N, N), each the 2x2 means of the one before."""
    scenes, count, _, size, _ = textures.shape
    level = textures.reshape(scenes * count, 3, size, size)
    levels, sides = [], []
    while True:
        levels.append(level.flatten(2))
        sides.append(level.shape[-1])
        if level.shape[-1] <= 1 or level.shape[-1] % 2:
            break
        level = F.avg_pool2d(level, 2)
    table = torch.cat(levels, -1).permute(0, 2, 1).reshape(-1, 3).contiguous()
    side = torch.tensor(sides, device=textures.device)
    first = torch.cumsum(side * side, 0) - side * side
    return Pyramid(table, first, side)


def sample_pyramid(pyramid: Pyramid, which: Tensor, uv: Tensor, footprint: Tensor) -> Tensor:
    """Trilinear lookup with mirrored repetition.

    which (...): row of the texture (scene * T + slot); uv (..., 2) in repeats; footprint (...): width of a sample in
    repeats -> colours (..., 3).
    """
    table, first, side = pyramid
    texels = int((side * side).sum())
    level = torch.log2((footprint * side[0]).clamp(min=1)).clamp(max=len(side) - 1.001)
    low = level.floor().long()
    blend = (level - low)[..., None]
    folded = (uv % 2 - 1).abs()
    base = which * texels

    def bilinear(mip: Tensor) -> Tensor:
        n = side[mip]
        x, y = (folded * n[..., None] - 0.5).unbind(-1)
        x0, y0 = x.floor(), y.floor()
        fx, fy = (x - x0)[..., None], (y - y0)[..., None]
        top = (n - 1).to(x.dtype)
        xs = [torch.minimum(c.clamp(min=0), top).long() for c in (x0, x0 + 1)]
        ys = [torch.minimum(c.clamp(min=0), top).long() for c in (y0, y0 + 1)]
        row = base + first[mip]
        upper = table[row + ys[0] * n + xs[0]] * (1 - fx) + table[row + ys[0] * n + xs[1]] * fx
        lower = table[row + ys[1] * n + xs[0]] * (1 - fx) + table[row + ys[1] * n + xs[1]] * fx
        return upper * (1 - fy) + lower * fy

    return bilinear(low) * (1 - blend) + bilinear(low + 1) * blend
