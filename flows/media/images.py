"""Image files: read (OpenImageIO), resize and undistort (torch), write. Everything in between is uint8 sRGB (H, W, 3).

Pixel (row i, column j) has its centre at (j + 0.5, i + 0.5); `resize` maps the whole image area onto the whole image
area, as `Cameras.resize` does, and `undistort` keeps the image size and returns the intrinsics of what it made.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from flows.errors import InputError
from flows.media.files import MAX_PIXELS, first_line, opened
from flows.media.lens import distorted_pixels, filling_zoom
from schemas.documents import write_bytes

#: sRGB grey around images that are padded to squares: the middle of the range the autoencoder knows.
PADDING = 128
#: Formats that are written, by extension.
FORMATS = {".png": "PNG", ".jpg": "JPEG", ".jpeg": "JPEG"}
#: Pixels that are undistorted at a time.
STRIP_PIXELS = 1 << 20


def read_image(
    path: Path | str, max_pixels: int = MAX_PIXELS, background: float | None = 1.0, upright: bool = True
) -> tuple[np.ndarray, np.ndarray | None]:
    """Decode an image file to sRGB: (H, W, 3) uint8, and its alpha (H, W) uint8 or None where it has none.

    upright: turn it by its EXIF orientation; False keeps the pixels as they are stored, as COLMAP and its like do.

    16-bit files are rounded; floating-point files (EXR, HDR) are linear Rec. 709 by definition: encoded to sRGB and
    clipped. Transparency is composited, in sRGB values as NeRF's synthetic scenes do, on a grey of `background`
    (1 = white); None leaves the unassociated colours as they are in the file. Grey and palette become RGB.
    Raises InputError naming the file: missing, empty, truncated, not an image, CMYK, RAW, more than
    `max_pixels` (checked before decoding), NaN.
    """
    path = Path(path)
    with opened(path, max_pixels) as source:
        spec = source.spec()
        channels = list(spec.channelnames)
        is_float = str(spec.format) in ("half", "float", "double")
        pixels = source.read_image("uint8" if str(spec.format) == "uint8" else "float")
        error = source.geterror()
        orientation = spec.get_int_attribute("Orientation", 1)
    # A truncated JPEG comes back as an array, and only the error text tells.
    if pixels is None or error:
        raise InputError(f"{path} is damaged or incomplete ({first_line(error)}); copy it again or remove it.")
    colour_ids, alpha_id = _channel_ids(channels, path)
    if is_float:
        if not np.isfinite(pixels).all():
            raise InputError(f"{path} has NaN or infinite pixels; repair or remove it.")
        pixels = (
            np.concatenate([_srgb_encoded(pixels[..., :-1]), pixels[..., -1:]], -1)
            if alpha_id is not None
            else (_srgb_encoded(pixels))
        )
    if upright:
        pixels = _upright(pixels, orientation)
    rgb = pixels[..., colour_ids]
    alpha = None if alpha_id is None else pixels[..., alpha_id]
    if alpha is not None and background is not None:
        weight = as_float(alpha)[..., None]
        rgb = as_float(rgb) * weight + background * (1 - weight)
    return np.ascontiguousarray(to_uint8(rgb)), None if alpha is None else np.ascontiguousarray(to_uint8(alpha))


def read_mask(path: Path | str, upright: bool = True) -> np.ndarray:
    """(H, W) uint8, 255 where the mask image is at least half white; upright as for `read_image`."""
    rgb, alpha = read_image(path, background=None, upright=upright)
    return np.where((rgb.max(-1) if alpha is None else np.minimum(rgb.max(-1), alpha)) >= 128, 255, 0).astype(np.uint8)


def as_float(values: np.ndarray) -> np.ndarray:
    """uint8 to float32 in [0, 1]; floats pass through as float32."""
    return values.astype(np.float32) / 255 if values.dtype == np.uint8 else values.astype(np.float32)


def to_uint8(values: np.ndarray | Tensor) -> np.ndarray:
    """[0, 1] floats to uint8 by rounding, clipped; uint8 passes through. Accepts a tensor on any device."""
    if isinstance(values, Tensor):
        values = values.detach().cpu().numpy()
    if values.dtype == np.uint8:
        return values
    return (np.clip(values, 0, 1) * 255 + 0.5).astype(np.uint8)


def resize(image: np.ndarray, width: int, height: int) -> np.ndarray:
    """Resample (H, W, C) or (H, W) uint8 to width x height: cubic, antialiased when shrinking, in sRGB values.

    The whole area maps onto the whole area, so `Cameras.resize(width, height)` gives the matching intrinsics.
    """
    if image.shape[:2] == (height, width):
        return image
    if min(width, height) < 1:
        raise InputError(f"An image cannot be resized to {width} x {height} pixels; both sides must be at least 1.")
    out = F.interpolate(_planes(image), size=(height, width), mode="bicubic", antialias=True, align_corners=False)
    return _from_planes(out, image.ndim)


def square_image(image: np.ndarray, box: Sequence[int], image_size: int) -> np.ndarray:
    """(image_size, image_size, 3) uint8: the square [x0, y0, side] of the image in its pixels, grey beyond it."""
    x0, y0, side = box
    height, width = image.shape[:2]
    square = np.full((side, side, 3), PADDING, np.uint8)
    left, top = max(x0, 0), max(y0, 0)
    part = image[top : min(y0 + side, height), left : min(x0 + side, width)]
    square[top - y0 : top - y0 + part.shape[0], left - x0 : left - x0 + part.shape[1]] = part
    return resize(square, image_size, image_size)


def undistort(
    image: np.ndarray, intrinsics: Tensor, distortion: Tensor, nearest: bool = False, fisheye: bool = False
) -> tuple[np.ndarray, Tensor]:
    """The image a pinhole camera would have taken: same size, and its intrinsics (3, 3) float64.

    image (H, W, C) or (H, W) uint8; intrinsics (3, 3) of this image; distortion and fisheye as in `lens.distort`. Size
    and principal point stay; one zoom of the focal lengths is chosen as the smallest with no pixel outside the photo,
    so there is no black border and nearly the whole view stays. Own inverse warp: cubic sampling (`nearest` for masks).
    Raises InputError where no moderate zoom does it (coefficients that no lens has).
    """
    intrinsics = intrinsics.double()
    if not distortion.any() and not fisheye:
        return image, intrinsics
    height, width = image.shape[:2]
    new = intrinsics.clone()
    new[0, 0], new[1, 1] = intrinsics[[0, 1], [0, 1]] * filling_zoom(intrinsics, distortion, width, height, fisheye)
    planes, out = _planes(image), np.empty_like(image)
    rows = max(1, STRIP_PIXELS // width)
    for first in range(0, height, rows):  # the positions of all pixels of a large photo would take gigabytes
        last = min(first + rows, height)
        y, x = torch.meshgrid(torch.arange(first, last) + 0.5, torch.arange(width) + 0.5, indexing="ij")
        source = distorted_pixels(torch.stack([x, y], -1).double(), new, intrinsics, distortion, fisheye)
        # In grid_sample without align_corners -1 to 1 is the area of the image.
        grid = (2 * source / torch.tensor([width, height]) - 1).float()
        mode = "nearest" if nearest else "bicubic"
        strip = F.grid_sample(planes, grid[None], mode=mode, padding_mode="border", align_corners=False)
        out[first:last] = _from_planes(strip, image.ndim)
    return out, new


def write_png(path: Path | str, image: np.ndarray | Tensor) -> None:
    """Write (H, W, 3), (H, W, 4) or (H, W), uint8 or [0, 1] floats, at once or not at all."""
    _write(Path(path), to_uint8(image), compress_level=4)


def write_jpeg(path: Path | str, image: np.ndarray | Tensor, quality: int = 93) -> None:
    """Write an image as JPEG, without alpha or chroma subsampling (4:4:4); otherwise like `write_png`."""
    _write(Path(path), to_uint8(image), quality=quality, subsampling=0)


def _channel_ids(channels: list[str], path: Path) -> tuple[list[int], int | None]:
    """Which channels are red, green, blue, and alpha."""
    names = [c.upper() for c in channels]
    alpha_id = names.index("A") if "A" in names else None
    if {"R", "G", "B"} <= set(names):
        return [names.index(c) for c in "RGB"], alpha_id
    if len(names) - (alpha_id is not None) == 1:
        return [0 if alpha_id != 0 else 1] * 3, alpha_id
    raise InputError(f"{path} has the channels {', '.join(channels)}; expected red, green and blue, or grey.")


def _srgb_encoded(linear: np.ndarray) -> np.ndarray:
    """IEC 61966-2-1, from [0, 1] clipped."""
    x = np.clip(linear, 0, 1)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-8) ** (1 / 2.4) - 0.055)


def _upright(pixels: np.ndarray, orientation: int) -> np.ndarray:
    """Apply the EXIF orientation (1 to 8) to (H, W, C)."""
    if orientation >= 5:
        pixels = pixels.swapaxes(0, 1)
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    return pixels[:, ::-1] if orientation in (2, 3, 6, 7) else pixels


def _planes(image: np.ndarray) -> Tensor:
    planes = torch.from_numpy(np.ascontiguousarray(image))
    return (planes[..., None] if image.ndim == 2 else planes).permute(2, 0, 1)[None].float()


def _from_planes(planes: Tensor, ndim: int) -> np.ndarray:
    image = (planes[0].clamp(0, 255) + 0.5).to(torch.uint8).permute(1, 2, 0).contiguous().numpy()
    return image[..., 0] if ndim == 2 else image


def _write(path: Path, pixels: np.ndarray, **options: Any) -> None:
    """Encode in memory, then write: libraries of image formats pass over writes that the system refuses, or end the
    process."""
    from PIL import Image

    kind = FORMATS.get(path.suffix.lower())
    if kind is None:
        raise InputError(f"{path} has no extension of an image format that is written; end it in .png or .jpg.")
    if kind == "JPEG" and pixels.ndim == 3:
        pixels = pixels[..., :3]
    encoded = io.BytesIO()
    Image.fromarray(pixels).save(encoded, kind, **options)
    try:
        write_bytes(path, encoded.getvalue())
    except OSError as error:
        raise InputError(f"{path} cannot be written ({error.strerror or error}).") from None
