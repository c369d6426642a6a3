"""Meshes of SuperTuxKart (.spm, little-endian).

"SP", a byte (version << 3 | type; 1 = with a skeleton, 2 = static), a byte of flags (1 normals, 2 colours,
4 tangents), 6 floats (bounding box), u16 materials, each two texture names with a length byte before them,
u16 sectors, each u16 buffers; a buffer is u32 vertices, u32 indices, u16 material, the vertices, the indices.
A vertex: 3 floats; [u32 normal, 10 bits an axis]; [colour: one byte 128 (white), or another and 3 bytes];
[2 half floats of texture coordinates where the first texture is named, 2 more where the second is; with
tangents, a u32]; [16 bytes of joints where there is a skeleton]. Indices take 1, 2 or 4 bytes by the number of
vertices.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flows.errors import InputError

MAX_BYTES = 256 * 2**20
_SKELETON, _STATIC = 1, 2
_WHITE = 128


@dataclass(frozen=True)
class Buffer:
    """One material's triangles (T, 3) int64 over V vertices, in the mesh's own left-handed frame (y up).

    points (V, 3) float32; normals (V, 3) float32 unit vectors, or None; colors (V, 3) uint8, linear factors;
    uv (V, 2) and uv2 (V, 2) float32, v downwards from the texture's top row; textures: first and second name, empty
    where there is none."""

    points: NDArray[np.float32]
    normals: NDArray[np.float32] | None
    colors: NDArray[np.uint8]
    uv: NDArray[np.float32]
    uv2: NDArray[np.float32]
    triangles: NDArray[np.int64]
    textures: tuple[str, str]


class _Bytes:
    """A cursor that never reads past the end."""

    def __init__(self, path: Path) -> None:
        if path.stat().st_size > MAX_BYTES:
            raise InputError(f"{path} is larger than {MAX_BYTES >> 20} MiB, too large for a mesh; is the file damaged?")
        self.path, self.data, self.at = path, path.read_bytes(), 0

    def take(self, count: int) -> bytes:
        if self.at + count > len(self.data):
            raise InputError(f"{self.path} ends in the middle of its mesh; fetch the package again.")
        self.at += count
        return self.data[self.at - count : self.at]

    def numbers(self, layout: str) -> tuple:
        return struct.unpack("<" + layout, self.take(struct.calcsize("<" + layout)))

    def name(self) -> str:
        return self.take(self.numbers("B")[0]).decode("utf-8", "replace")


def read_spm(path: Path) -> list[Buffer]:
    """The triangles of a mesh, one buffer a material and sector. Raises InputError for a file that is no such mesh, is
    cut short, or whose indices point outside."""
    source = _Bytes(path)
    if source.take(2) != b"SP":
        raise InputError(f"{path} is not an .spm mesh: it doesn't start with 'SP'.")
    kind, flags = source.numbers("BB")
    version, kind = kind >> 3, kind & 7
    if version != 1 or kind not in (_SKELETON, _STATIC):
        raise InputError(
            f"{path} is an .spm mesh of version {version}, type {kind}; version 1, types 1 and 2 are read."
        )
    source.numbers("6f")
    materials = [(source.name(), source.name()) for _ in range(source.numbers("H")[0])]
    buffers = []
    for _ in range(source.numbers("H")[0]):
        for _ in range(source.numbers("H")[0]):
            buffers.append(_buffer(source, materials, flags, kind))
    if kind == _STATIC and source.at != len(source.data):
        raise InputError(f"{path} has {len(source.data) - source.at} bytes after its mesh; fetch the package again.")
    return buffers


def _buffer(source: _Bytes, materials: list[tuple[str, str]], flags: int, kind: int) -> Buffer:
    count, indices, number = source.numbers("IIH")
    if number >= len(materials):
        raise InputError(f"{source.path} uses material {number} and lists {len(materials)}; fetch the package again.")
    textures = materials[number]
    normals, colors, tangents = flags & 1, flags >> 1 & 1, flags >> 2 & 1
    before = 12 + 4 * normals
    coordinates = (4 + (4 if textures[1] else 0) + 4 * tangents) if textures[0] else 0
    after = coordinates + (16 if kind == _SKELETON else 0)
    data = np.frombuffer(source.data, np.uint8)
    if source.at + count * (before + colors + after) > len(data):
        raise InputError(f"{source.path} ends in the middle of its mesh; fetch the package again.")
    starts, tints, end = _vertex_starts(data, source.at, count, before, after, bool(colors))
    if end > len(data):
        raise InputError(f"{source.path} ends in the middle of its mesh; fetch the package again.")

    def column(offsets: NDArray[np.int64], dtype: str, number: int) -> NDArray:
        width = np.dtype(dtype).itemsize * number
        return np.ascontiguousarray(data[offsets[:, None] + np.arange(width)]).view(dtype).reshape(len(offsets), number)

    tinted = tints & (data[np.minimum(starts + before, len(data) - 1)] != _WHITE)
    rgb = np.full((count, 3), 255, np.uint8)
    rgb[tinted] = column(starts[tinted] + before + 1, "u1", 3)
    at = starts + before + np.where(tints, np.where(tinted, 4, 1), 0)
    zero = np.zeros((count, 2), np.float32)
    uv = column(at, "<f2", 2).astype(np.float32) if textures[0] else zero
    uv2 = column(at + 4, "<f2", 2).astype(np.float32) if textures[0] and textures[1] else zero
    points = column(starts, "<f4", 3)
    if not (np.isfinite(points).all() and np.isfinite(uv).all()):
        raise InputError(f"{source.path} holds vertices that are not finite; fetch the package again.")
    source.at = end
    dtype = "<u1" if count <= 255 else "<u2" if count <= 65535 else "<u4"
    raw = np.frombuffer(source.take(indices * np.dtype(dtype).itemsize), dtype).astype(np.int64)
    if len(raw) % 3 or (len(raw) and raw.max() >= count):
        raise InputError(f"{source.path} has triangles of vertices that it doesn't hold; fetch the package again.")
    packed = column(starts + 12, "<u4", 1)[:, 0] if normals else None
    return Buffer(
        points, None if packed is None else unpacked_normals(packed), rgb, uv, uv2, raw.reshape(-1, 3), textures
    )


def _vertex_starts(
    data: NDArray[np.uint8], at: int, count: int, before: int, after: int, colored: bool
) -> tuple[NDArray[np.int64], NDArray[np.bool_], int]:
    """Where each vertex starts, which have a colour field, and where the last one ends."""
    if not colored:
        starts = at + np.arange(count, dtype=np.int64) * (before + after)
        return starts, np.zeros(count, bool), at + count * (before + after)
    starts, raw, limit = np.empty(count, np.int64), data.data, len(data)
    for vertex in range(count):  # a colour takes one byte or four: each vertex's start depends on the one before
        starts[vertex] = at
        if at + before >= limit:
            return starts, np.ones(count, bool), limit + 1
        at += before + (1 if raw[at + before] == _WHITE else 4) + after
    return starts, np.ones(count, bool), at


def unpacked_normals(packed: NDArray[np.uint32]) -> NDArray[np.float32]:
    """Unit vectors (V, 3) of three signed 10-bit fields, x in the lowest bits."""
    fields = np.stack([packed >> shift & 1023 for shift in (0, 10, 20)], -1).astype(np.int32)
    vectors = (np.where(fields > 511, fields - 1024, fields) / 511.0).astype(np.float32)
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-6)
