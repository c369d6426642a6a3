"""Files of splats that viewers open: 3DGS .ply, .splat and .spz, and readers of them."""

from __future__ import annotations

import gzip
import math
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from cat3d_core.normalization import Similarity
from cat3d_core.splats.gaussians import SH_0, Gaussians
from flows.errors import InputError
from flows.media.packed import gunzip
from schemas.documents import write_bytes

SPZ_MAGIC, SPZ_VERSION, SPZ_ANTIALIASED = 0x5053474E, 3, 1
SPZ_SCALES = (-10.0, 255 / 16 - 10.0)
"""Natural logarithms of the scales that .spz can say, in steps of 1/16."""
SPZ_BITS = 23
SPZ_COLOUR = 0.15
SPZ_STEPS = (1, 8, 16)
"""Steps to which .spz rounds harmonics of each degree (of 256)."""
_QUATERNION = 511
_SPLAT = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("colour", "u1", 4), ("quaternion", "u1", 4)])
#: .ply and .splat hold the axes of the frame as they are. Viewers take those of a .ply as x right, y down, z forward
#: and those of a .spz as x right, y up, z back, so that a .spz holds the frame turned by half round x.
_TURNED = Similarity(1.0, torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)), torch.zeros(3).double())


def write_ply(path: Path, gaussians: Gaussians) -> None:
    """3DGS .ply: float32 x y z nx ny nz f_dc f_rest opacity (logit) scale (logarithm) rot (w x y z)."""
    g = gaussians.to("cpu", torch.float32)
    unit = torch.nn.functional.normalize(g.quaternions, dim=-1)
    rest = g.harmonics[:, 1:].transpose(1, 2).flatten(1)  # all of red, then of green, then of blue
    zero = torch.zeros_like(g.means)
    columns = torch.cat([g.means, zero, g.harmonics[:, 0], rest, g.logits[:, None], g.log_scales, unit], 1)
    names = ["x", "y", "z", "nx", "ny", "nz", *_numbered("f_dc", 3), *_numbered("f_rest", rest.shape[1]), "opacity"]
    names += [*_numbered("scale", 3), *_numbered("rot", 4)]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(g)}"]
    header += [*(f"property float {name}" for name in names), "end_header\n"]
    write_bytes(path, "\n".join(header).encode("ascii") + columns.numpy().astype("<f4").tobytes())


def _numbered(name: str, count: int) -> list[str]:
    return [f"{name}_{i}" for i in range(count)]


def read_ply(path: Path) -> Gaussians:
    """Read a 3DGS .ply of float32 properties and harmonics up to degree 2. Raises InputError for anything else."""
    raw = path.read_bytes()
    head, found, body = raw.partition(b"end_header\n")
    lines = head.decode("ascii", "replace").split("\n")
    names = [line.split()[-1] for line in lines if line.startswith("property float ")]
    other = [line for line in lines if line.startswith("property") and not line.startswith("property float ")]
    count = next((int(line.split()[-1]) for line in lines if line.startswith("element vertex ")), -1)
    needed = {"x", "y", "z", "opacity", *_numbered("f_dc", 3), *_numbered("scale", 3), *_numbered("rot", 4)}
    if not found or "format binary_little_endian 1.0" not in lines or other or not needed <= set(names):
        raise InputError(f"{path} is not a .ply of 3D Gaussian splatting (binary, little-endian, float32 properties).")
    if len(body) != 4 * count * len(names):
        raise InputError(f"{path} is damaged: {len(body)} bytes follow its header instead of {4 * count * len(names)}.")
    table = torch.from_numpy(np.frombuffer(body, "<f4").reshape(count, len(names)).astype(np.float32))

    def columns(*wanted: str) -> torch.Tensor:
        return table[:, [names.index(name) for name in wanted]]

    rest = [name for name in names if name.startswith("f_rest_")]
    harmonics = columns(*_numbered("f_dc", 3))[:, None]
    if rest:
        if len(rest) not in (9, 24):
            raise InputError(
                f"{path} has {len(rest)} f_rest properties; harmonics of degree 1 have 9 and of 2 have 24."
            )
        higher = columns(*_numbered("f_rest", len(rest))).unflatten(1, (3, -1)).transpose(1, 2)
        harmonics = torch.cat([harmonics, higher], 1)
    means, quaternions, log_scales = columns(*"xyz"), columns(*_numbered("rot", 4)), columns(*_numbered("scale", 3))
    return Gaussians(means, quaternions, log_scales, columns("opacity")[:, 0], harmonics)


def write_splat(path: Path, gaussians: Gaussians) -> None:
    """antimatter15's .splat: 32 bytes each, the largest and most opaque first; colours of degree 0 in 8 bits."""
    g = gaussians.to("cpu", torch.float32)
    order = (g.log_scales.sum(1).exp() * g.opacities).argsort(descending=True, stable=True)
    g = g[order]
    rows = np.empty(len(g), _SPLAT)
    rows["mean"], rows["scale"] = g.means.numpy(), g.scales.numpy()
    colour = 0.5 + SH_0 * g.harmonics[:, 0]
    rows["colour"] = _bytes(torch.cat([colour, g.opacities[:, None]], 1) * 255)
    rows["quaternion"] = _bytes(torch.nn.functional.normalize(g.quaternions, dim=-1) * 128 + 128)
    write_bytes(path, rows.tobytes())


def read_splat(path: Path) -> Gaussians:
    """Read a .splat, in its own order. Raises InputError where its length is not whole."""
    raw = path.read_bytes()
    if len(raw) % _SPLAT.itemsize:
        raise InputError(f"{path} is no .splat file or damaged: its length is no multiple of {_SPLAT.itemsize} bytes.")
    rows = np.frombuffer(raw, _SPLAT)
    colour, quaternion = (torch.from_numpy(rows[name].astype(np.float32)) for name in ("colour", "quaternion"))
    return Gaussians(
        torch.from_numpy(rows["mean"].copy()), (quaternion - 128) / 128, torch.from_numpy(np.log(rows["scale"])),
        _logit(colour[:, 3] / 255), ((colour[:, None, :3] / 255) - 0.5) / SH_0,
    )  # fmt: skip


def write_spz(path: Path, gaussians: Gaussians, antialias: bool = True) -> None:
    """Niantic's .spz, version 3: one gzip stream, some 20 bytes each before compression.

    Raises InputError for sizes that it cannot say (scales from 4.5e-5 to 380 units, positions up to 4 million).
    """
    g = gaussians.to("cpu", torch.float32)
    low, high = SPZ_SCALES
    beyond = int(((g.log_scales < low - 1 / 32) | (g.log_scales > high + 1 / 32)).any(1).sum())
    reach = float(g.means.abs().max()) if len(g) else 0.0
    bits = SPZ_BITS - max(0, math.frexp(reach)[1])
    if beyond or bits < 1:
        raise InputError(
            f"{path.name} cannot say these splats: {beyond} of {len(g)} are smaller than {math.exp(low):.2g} or larger "
            f"than {math.exp(high):.3g} units, and positions reach {reach:.3g}. Choose the frame `scene`, or .ply."
        )
    g = g.mapped(_TURNED)
    fixed = (g.means.double() * 2.0**bits).round().clamp(-(2**23), 2**23 - 1).to(torch.int32).numpy()
    quaternion = torch.nn.functional.normalize(g.quaternions, dim=-1)[:, [1, 2, 3, 0]]  # x, y, z, w
    parts = [
        fixed.astype("<i4").view(np.uint8).reshape(-1, 3, 4)[:, :, :3],
        _bytes(g.opacities * 255),
        _bytes((g.harmonics[:, 0] * SPZ_COLOUR + 0.5) * 255),
        _bytes((g.log_scales + 10) * 16),
        _smallest_three(quaternion.double().numpy()),
    ]
    for degree in range(1, g.degree + 1):
        step = SPZ_STEPS[degree]
        rows = g.harmonics[:, degree**2 : (degree + 1) ** 2] * 128 / step
        parts.append(_bytes(rows.round() * step + 128))
    harmonics = [np.concatenate([part.reshape(len(g), -1) for part in parts[5:]], 1)] if g.degree else []
    header = struct.pack("<IIIBBBB", SPZ_MAGIC, SPZ_VERSION, len(g), g.degree, bits, SPZ_ANTIALIASED * antialias, 0)
    body = b"".join(np.ascontiguousarray(part).tobytes() for part in [*parts[:5], *harmonics])
    write_bytes(path, gzip.compress(header + body, 9, mtime=0))


def read_spz(path: Path) -> Gaussians:
    """Read a .spz of version 3, up to degree 2. Raises InputError for another version or a damaged file."""
    try:
        raw = gunzip(path)
        magic, version, count, degree, bits, _, _ = struct.unpack_from("<IIIBBBB", raw)
    except struct.error as error:
        raise InputError(f"{path} is no .spz file or damaged ({error}).") from None
    widths = [9, 1, 3, 3, 4, 3 * ((degree + 1) ** 2 - 1)]
    if magic != SPZ_MAGIC or version != SPZ_VERSION or degree > 2 or len(raw) != 16 + count * sum(widths):
        raise InputError(f"{path} is not a .spz of version {SPZ_VERSION} with harmonics up to degree 2, or damaged.")
    ends = 16 + count * np.cumsum([0, *widths])
    table = [np.frombuffer(raw[a:b], np.uint8).reshape(count, -1) for a, b in zip(ends, ends[1:], strict=False)]
    fixed = np.zeros((count, 3, 4), np.uint8)
    fixed[:, :, 1:] = table[0].reshape(count, 3, 3)
    means = (fixed.view("<i4")[..., 0] >> 8).astype(np.float64) / 2.0**bits
    numbers = [torch.from_numpy(part.astype(np.float32)) for part in table]
    harmonics = ((numbers[2] / 255 - 0.5) / SPZ_COLOUR)[:, None]
    higher = ((numbers[5] - 128) / 128).view(count, -1, 3)
    return Gaussians(
        torch.from_numpy(means).float(), torch.from_numpy(_whole(table[4])).float(), numbers[3] / 16 - 10,
        _logit(numbers[1][:, 0] / 255), torch.cat([harmonics, higher], 1),
    ).mapped(_TURNED)  # fmt: skip


def _smallest_three(quaternion: np.ndarray) -> np.ndarray:
    """(N, 4) bytes of unit quaternions (x, y, z, w): the place of the largest part in 2 bits, then sign and 9 bits of
    the others, in units of the root of 1/2 and with the largest positive."""
    rows = np.arange(len(quaternion))
    largest = np.abs(quaternion).argmax(1)
    quaternion = quaternion * np.where(quaternion[rows, largest] < 0, -1.0, 1.0)[:, None]
    packed = largest.astype(np.uint32)
    for i in range(4):
        part = quaternion[:, i]
        size = np.minimum(np.abs(part) * math.sqrt(2) * _QUATERNION + 0.5, _QUATERNION).astype(np.uint32)
        both = (packed << np.uint32(10)) | ((part < 0).astype(np.uint32) << np.uint32(9)) | size
        packed = np.where(largest == i, packed, both)
    return packed.astype("<u4").view(np.uint8).reshape(-1, 4)


def _whole(packed: np.ndarray) -> np.ndarray:
    """The unit quaternions (N, 4) w, x, y, z of `_smallest_three`."""
    bits = np.ascontiguousarray(packed).view("<u4")[:, 0]
    largest = bits >> np.uint32(30)
    out = np.zeros((len(bits), 4))
    for i in (3, 2, 1, 0):
        value = (bits & np.uint32(511)) / _QUATERNION / math.sqrt(2) * np.where(bits & np.uint32(512), -1.0, 1.0)
        out[:, i] = np.where(largest == i, 0.0, value)
        bits = np.where(largest == i, bits, bits >> np.uint32(10))
    out[np.arange(len(out)), largest] = np.sqrt(np.maximum(0.0, 1 - np.square(out).sum(1)))
    return out[:, [3, 0, 1, 2]]


def _bytes(values: torch.Tensor) -> np.ndarray:
    return values.round().clamp(0, 255).to(torch.uint8).numpy()


def _logit(opacity: torch.Tensor) -> torch.Tensor:
    """As finite as 8 bits allow: 0 and 255 count as half a step inside."""
    return opacity.clamp(0.5 / 255, 1 - 0.5 / 255).logit()


WRITERS: dict[str, Callable[[Path, Gaussians], None]] = {".ply": write_ply, ".splat": write_splat, ".spz": write_spz}
READERS: dict[str, Callable[[Path], Gaussians]] = {".ply": read_ply, ".splat": read_splat, ".spz": read_spz}
