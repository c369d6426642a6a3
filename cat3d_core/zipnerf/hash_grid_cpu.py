"""The fused hash grid query as a small C++ kernel (hash_grid.cpp)."""

from __future__ import annotations

import ctypes
import functools
from typing import Any

import torch
from torch import Tensor

from cat3d_core.cpu_library import library, pointer
from cat3d_core.zipnerf.grid_layout import GridLayout


def available() -> bool:
    """Whether the kernel is there; compiles it at the first call and warns once where that fails."""
    return library("zipnerf/hash_grid") is not None


@functools.cache
def _levels(layout: GridLayout) -> Any:
    rows = [
        (layout.offsets[level], n, layout.offsets[level + 1] - layout.offsets[level], int(layout.hashed(level)))
        for level, n in enumerate(layout.resolutions)
    ]
    flat = [value for row in rows for value in row]
    return (ctypes.c_int64 * len(flat))(*flat)


def _call(
    backward: bool,
    source: Tensor,
    positions: Tensor,
    std: Tensor,
    out: Tensor,
    layout: GridLayout,
) -> None:
    kernels = library("zipnerf/hash_grid")
    assert kernels is not None
    status = kernels.hash_grid(
        ctypes.c_int(backward), pointer(source), pointer(positions), pointer(std), pointer(out),
        _levels(layout), ctypes.c_int(layout.levels), ctypes.c_int(layout.features),
        ctypes.c_int64(std.shape[0]), ctypes.c_int(std.shape[1]), ctypes.c_int(torch.get_num_threads()),
    )  # fmt: skip
    if status:
        raise ValueError(
            f"The CPU kernel has 1, 2, 4 or 8 features and up to 6 samples and 32 levels, not {layout.features} "
            f"features, {std.shape[1]} samples and {layout.levels} levels."
        )


class _Query(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, table: Tensor, positions: Tensor, std: Tensor, layout: GridLayout) -> Tensor:
        table, positions, std = table.contiguous(), positions.contiguous(), std.contiguous()
        out = table.new_empty((std.shape[0], layout.levels, layout.features + 1))
        _call(False, table, positions, std, out, layout)
        ctx.save_for_backward(positions, std)
        ctx.layout = layout
        return out

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None, None]:  # type: ignore[override]
        positions, std = ctx.saved_tensors
        table_gradient = gradient.new_zeros((ctx.layout.rows, ctx.layout.features))
        _call(True, gradient.contiguous(), positions, std, table_gradient, ctx.layout)
        return table_gradient, None, None, None


def query(table: Tensor, positions: Tensor, std: Tensor, layout: GridLayout) -> Tensor:
    """As `grid_reference.query_reference` for float32 CPU tensors; deterministic, gradient for the table only.

    Raises ValueError for shapes that do not fit the layout (the kernel itself checks nothing).
    """
    if table.shape != (layout.rows, layout.features) or positions.shape != (*std.shape, 3) or std.ndim != 2:
        raise ValueError(
            f"Expected table {(layout.rows, layout.features)}, positions (N, S, 3) and std (N, S); got "
            f"{tuple(table.shape)}, {tuple(positions.shape)}, {tuple(std.shape)}."
        )
    if any(tensor.dtype != torch.float32 or tensor.device.type != "cpu" for tensor in (table, positions, std)):
        raise ValueError("The CPU hash grid kernel takes float32 tensors on the CPU.")
    return _Query.apply(table, positions.detach(), std.detach(), layout)  # type: ignore[no-any-return]
