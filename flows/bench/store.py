"""Codecs and number formats of the scene store: size, speed and error on procedural views and their latents.

Every array is written and read as the store does it: one view a chunk, one file a chunk, crc32c at the end. Times are
CPU seconds of this process (user and system, all threads), with files that stay in memory: the work of codecs, zarr and
the system, whatever else the machine is busy with. A disk's own time comes on top.
"""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
import zarr
from numpy.typing import NDArray
from zarr.codecs import BloscCodec, Crc32cCodec, GzipCodec

from cat3d_core.diffusion import load_model
from cat3d_core.random import normal
from cat3d_core.synthetic import random_cameras, random_scene, trace
from cat3d_core.weights import default_model_path
from flows.bench import limits
from schemas import arrays

#: Name -> compressor in front of crc32c; None stores the bytes as they are.
CODECS: dict[str, Any] = {
    "raw": None,
    "lz4-1 shuffle": BloscCodec(cname="lz4", clevel=1, shuffle="shuffle"),
    "zstd-1": BloscCodec(cname="zstd", clevel=1, shuffle="noshuffle"),
    "zstd-1 shuffle": BloscCodec(cname="zstd", clevel=1, shuffle="shuffle"),
    "zstd-1 bitshuffle": BloscCodec(cname="zstd", clevel=1, shuffle="bitshuffle"),
    "zstd-3 shuffle": BloscCodec(cname="zstd", clevel=3, shuffle="shuffle"),
    "zstd-3 bitshuffle": BloscCodec(cname="zstd", clevel=3, shuffle="bitshuffle"),
    "zstd-9 bitshuffle": BloscCodec(cname="zstd", clevel=9, shuffle="bitshuffle"),
    "gzip-5": GzipCodec(level=5),
}
Pair = tuple[NDArray[Any], NDArray[np.float32]]  # what is stored, and what a reader makes of it


def _rounded(dtype: Any, scale: float = 1.0) -> Callable[[NDArray[np.float32]], Pair]:
    def convert(values: NDArray[np.float32]) -> Pair:
        scaled = values * np.float32(scale)
        stored = (np.rint(scaled) if np.issubdtype(dtype, np.integer) else scaled).astype(dtype)
        return stored, (stored.astype(np.float64) / scale).astype(np.float32)

    return convert


def _bfloat16(values: NDArray[np.float32]) -> Pair:
    short = torch.from_numpy(values).bfloat16()  # zarr has no bfloat16: its bits are stored
    return short.view(torch.uint16).numpy(), short.float().numpy()


def _linear_uint8(values: NDArray[np.float32]) -> Pair:
    """256 steps between the extremes of every view and channel (V, C, h, w)."""
    low, high = (f(values, axis=(2, 3), keepdims=True) for f in (np.min, np.max))
    step = np.maximum((high - low) / 255, np.finfo(np.float32).tiny)
    stored = np.rint((values - low) / step).astype(np.uint8)
    return stored, low + stored * step


#: Kind of array in the store -> number format -> conversion. The first is what the store has.
FORMATS: dict[str, dict[str, Callable[[NDArray[np.float32]], Pair]]] = {
    "image": {
        "uint8": _rounded(np.uint8, 255),
        "uint16": _rounded(np.uint16, 65535),
        "float16": _rounded(np.float16),
        "float32": _rounded(np.float32),
    },
    "latent": {
        "float16": _rounded(np.float16),
        "bfloat16": _bfloat16,
        "uint8 per channel": _linear_uint8,
        "float32": _rounded(np.float32),
    },
}


def views_and_latents(count: int, size: int) -> tuple[NDArray[np.float32], NDArray[np.float32], str]:
    """Procedural views (V, size, size, 3) in [0, 1], their latents (V, C, size/8, size/8), and where the latents are
    from: the default model's autoencoder, or, without one, unit normal noise (the most that latents can hold)."""
    scene = random_scene("mip360", 0)
    images = trace(scene, random_cameras(scene, 0, count, size, size)).image.cpu().float()
    try:
        with torch.no_grad():
            latents, source = load_model(default_model_path()).autoencoder.encode(images), "default autoencoder"
    except FileNotFoundError:
        latents, source = normal((count, 8, size // 8, size // 8), 0, "bench latents"), "unit normal noise"
    return images.permute(0, 2, 3, 1).contiguous().numpy(), latents.float().numpy(), source


def rows(views: int = 8, size: int = 512, repeats: int = 5) -> list[dict[str, Any]]:
    """One row per content (image, latent), format and codec: `bytes_per_view` on disk, `ratio` (to the bytes in that
    format without compression), `write_mb_s` and `read_mb_s` (1e6 bytes before compression per CPU second, best of
    `repeats`, the codecs taking turns), `cpu_ms_per_view` (written and read once), `error` (root mean
    square, in units of [0, 1] for images and of the latents' standard deviation), `share_of_limit` (what the bytes on
    disk take as one large file, written and read, over what they took: `limits`), `store_format`, `store_codec`,
    `default`: whether the store uses the format, the codec, and both for this content."""
    images, latents, source = views_and_latents(views, size)
    found = _content_rows("image", images, "procedural", repeats)
    return found + _content_rows("latent", latents, source, 4 * repeats)  # small, so that their times vary more


def photo_rows(photos: list[NDArray[np.uint8]], source: str, size: int, repeats: int = 5) -> list[dict[str, Any]]:
    """The same for the middle of photos (H, W, 3) of 8 bits, `size` pixels square or as much as all of them have."""
    height, width = (min(size, *(photo.shape[axis] for photo in photos)) for axis in (0, 1))
    middles = [(p[(p.shape[0] - height) // 2 :, (p.shape[1] - width) // 2 :])[:height, :width] for p in photos]
    return _content_rows("image", np.stack(middles).astype(np.float32) / np.float32(255), source, repeats)


def _content_rows(kind: str, values: NDArray[np.float32], source: str, repeats: int) -> list[dict[str, Any]]:
    unit = float(values.std()) if kind == "latent" else 1.0
    out, own = [], None
    for number, (name, convert) in enumerate(FORMATS[kind].items()):
        stored, decoded = convert(values)
        error = math.sqrt(float(np.square(decoded - values, dtype=np.float64).mean())) / unit
        if number == 0:
            own = _default_codec(stored, kind)
        common = {"content": kind, "source": source, "format": name, "store_format": number == 0, "error": error}
        common |= {"views": len(values), "shape": "x".join(map(str, values.shape[1:]))}
        for codec, measured in _measure(stored, repeats).items():
            choice = {"codec": codec, "store_codec": codec == own, "default": number == 0 and codec == own}
            out.append(common | choice | measured)
    return out


def _codecs(folder: Path) -> list[dict[str, Any]]:
    metadata = zarr.open_array(str(folder), mode="r").metadata
    return metadata.to_dict()["codecs"]  # type: ignore[return-value]


def _create(folder: Path, stored: NDArray[Any], codec: str) -> zarr.Array:
    compressors = [c for c in (CODECS[codec], Crc32cCodec()) if c is not None]
    return zarr.create_array(
        str(folder), shape=stored.shape, dtype=stored.dtype, chunks=(1, *stored.shape[1:]), compressors=compressors,
        filters=None, chunk_key_encoding={"name": "default", "separator": "."},
    )  # fmt: skip


def _default_codec(stored: NDArray[Any], kind: str) -> str | None:
    """Which of CODECS the scene store uses for arrays of this kind, asked of the store itself."""
    with tempfile.TemporaryDirectory(prefix="cat3d-bench-") as folder:
        arrays.create(Path(folder) / "store", stored.shape, stored.dtype.name, kind)
        wanted = _codecs(Path(folder) / "store")
        for codec in CODECS:
            _create(Path(folder) / codec, stored, codec)
            if _codecs(Path(folder) / codec) == wanted:
                return codec
    return None


def _measure(stored: NDArray[Any], repeats: int) -> dict[str, dict[str, float]]:
    write: dict[str, float] = dict.fromkeys(CODECS, math.inf)
    read, size = dict(write), dict(write)
    for _ in range(repeats):
        for codec in CODECS:
            with tempfile.TemporaryDirectory(prefix="cat3d-bench-") as folder:
                array = _create(Path(folder), stored, codec)
                start = time.process_time()
                for view in range(len(stored)):
                    array[view] = stored[view]
                middle = time.process_time()
                back = [array[view] for view in range(len(stored))]
                end = time.process_time()
                if not np.array_equal(np.stack(back), stored):
                    raise ValueError(f"Codec {codec} gave back other values than were stored.")
                write[codec] = min(write[codec], middle - start)
                read[codec] = min(read[codec], end - middle)
                size[codec] = sum(f.stat().st_size for f in Path(folder).iterdir() if f.name != "zarr.json")
    return {
        codec: {
            "bytes_per_view": size[codec] / len(stored),
            "ratio": size[codec] / stored.nbytes,
            "write_mb_s": stored.nbytes / 1e6 / write[codec],
            "read_mb_s": stored.nbytes / 1e6 / read[codec],
            "cpu_ms_per_view": 1e3 * (write[codec] + read[codec]) / len(stored),
            **limits.file_columns(
                size[codec], size[codec], write[codec] + read[codec], Path(tempfile.gettempdir()), "cpu"
            ),
        }
        for codec in CODECS
    }
