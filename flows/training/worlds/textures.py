"""Textures of a world in one flat table of mip levels, looked up for many rays at once."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flows.errors import InputError

MAX_SIDE = 512
MAX_FILE_PIXELS = 64 * 2**20
GREY = (128, 128, 128, 255)

_CODES = np.arange(256) / 255
LINEAR_FROM_SRGB = np.where(_CODES <= 0.04045, _CODES / 12.92, ((_CODES + 0.055) / 1.055) ** 2.4).astype(np.float32)


def srgb_from_linear(linear: NDArray) -> NDArray:
    """IEC 61966-2-1 encoding of linear light in [0, 1]."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-8) ** (1 / 2.4) - 0.055)


def read_texture(path: Path, mask: Path | None = None, max_side: int = MAX_SIDE) -> NDArray[np.uint8]:
    """(H, W, 4) sRGB colour and opacity, reduced to sides of powers of two of at most max_side. mask: an image whose
    brightness is the opacity. Raises InputError for a file that is no image."""
    from PIL import Image  # a training on a borrowed machine, which may lack it, reads finished renders

    try:
        with Image.open(path) as image:
            if image.width * image.height > MAX_FILE_PIXELS:
                raise InputError(f"{path} has {image.width} x {image.height} pixels, too many for a texture.")
            rgba = image.convert("RGBA")
        if mask is not None:
            with Image.open(mask) as opacity:
                rgba.putalpha(opacity.convert("L").resize(rgba.size))
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path} can't be read as an image ({error}); fetch the package again.") from None
    width, height = (min(max_side, 1 << round(np.log2(side))) for side in rgba.size)
    return np.asarray(rgba.resize((width, height), Image.Resampling.BOX) if rgba.size != (width, height) else rgba)


def mip_levels(image: NDArray[np.uint8]) -> list[NDArray[np.uint8]]:
    """The image (H, W, 4), sides powers of two, and its halvings down to one texel; means of linear light, weighted
    with opacity so that what is cut away does not bleed into leaves."""
    levels, alpha = [image], image[..., 3:].astype(np.float32) / 255
    color: NDArray = LINEAR_FROM_SRGB[image[..., :3]]
    while max(levels[-1].shape[:2]) > 1:
        weight = alpha + 1e-4
        color, weight, alpha = _halved(color * weight), _halved(weight), _halved(alpha)
        color = color / weight
        codes = np.concatenate([srgb_from_linear(color), alpha], -1)
        levels.append((255 * codes.clip(0, 1) + 0.5).astype(np.uint8))
    return levels


def _halved(x: NDArray) -> NDArray:
    """Means of 2 x 2, or of pairs where one side is 1 already."""
    if x.shape[0] > 1:
        x = (x[0::2] + x[1::2]) / 2
    return (x[:, 0::2] + x[:, 1::2]) / 2 if x.shape[1] > 1 else x


@dataclass(frozen=True)
class Atlas:
    """All textures: texels (S, 4) uint8; start (N, L) where level l of texture n starts in them (its last level is
    repeated); width and height (N,) of level 0; clamped (N,): edges are held instead of repeated."""

    texels: NDArray[np.uint8]
    start: NDArray[np.int64]
    width: NDArray[np.int64]
    height: NDArray[np.int64]
    clamped: NDArray[np.bool_]

    @staticmethod
    def of(images: list[NDArray[np.uint8]], clamped: list[bool]) -> Atlas:
        """The table of images (H, W, 4) whose sides are powers of two."""
        parts: list[NDArray[np.uint8]] = []
        starts: list[list[int]] = []
        at = 0
        for image in images:
            levels = mip_levels(image)
            starts.append([])
            for level in levels:
                starts[-1].append(at)
                parts.append(level.reshape(-1, 4))
                at += level.shape[0] * level.shape[1]
        most = max(map(len, starts))
        table = np.array([row + [row[-1]] * (most - len(row)) for row in starts], np.int64)
        sides = np.array([image.shape[:2] for image in images], np.int64)
        return Atlas(np.concatenate(parts), table, sides[:, 1], sides[:, 0], np.array(clamped))

    def opacity(self, texture: NDArray, uv: NDArray) -> NDArray[np.float32]:
        """(R,) opacity of the nearest texel of level 0; arguments as in `sample`."""
        width, height = self.width[texture], self.height[texture]
        uv = np.where(self.clamped[texture][:, None], uv.clip(0, 1), uv - np.floor(uv))
        column = np.minimum((uv[:, 0] * width).astype(np.int64), width - 1)
        row = np.minimum((uv[:, 1] * height).astype(np.int64), height - 1)
        return self.texels[self.start[texture, 0] + row * width + column, 3] / np.float32(255)

    def sample(self, texture: NDArray, uv: NDArray, level: NDArray) -> NDArray[np.float32]:
        """Linear colour (R, 3), bilinear within the nearest mip level.

        texture (R,) numbers; uv (R, 2), v downwards from the top row, texel centres at half texels; level (R,)."""
        most = np.log2(np.maximum(self.width, self.height)).round().astype(np.int64)[texture]
        level = np.clip(np.rint(level).astype(np.int64), 0, most)
        width = np.maximum(self.width[texture] >> level, 1)
        height = np.maximum(self.height[texture] >> level, 1)
        clamped = self.clamped[texture][:, None]
        uv = np.where(clamped, uv.clip(0, 1), uv - np.floor(uv))
        x, y = uv[:, 0] * width - 0.5, uv[:, 1] * height - 0.5
        column, row = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
        right, below = (x - column).astype(np.float32)[:, None], (y - row).astype(np.float32)[:, None]
        start, clamped = self.start[texture, level], clamped[:, 0]
        out = np.zeros((len(uv), 3), np.float32)
        for i, across in ((0, 1 - right), (1, right)):
            c = np.where(clamped, (column + i).clip(0, width - 1), (column + i) & (width - 1))
            for j, down in ((0, 1 - below), (1, below)):
                r = np.where(clamped, (row + j).clip(0, height - 1), (row + j) & (height - 1))
                out += across * down * LINEAR_FROM_SRGB[self.texels[start + r * width + c, :3]]
        return out
