"""The fused hash grid query in Triton, for NVIDIA GPUs; with TRITON_INTERPRET=1 it runs on the CPU, for tests.

One program handles a block of intervals at one level, levels outermost, so that one level's table stays in the L2
cache. Backward recomputes the corners and adds with relaxed atomics. Under `torch.use_deterministic_algorithms(True)`
it adds 64-bit fixed-point numbers instead: integer sums do not depend on their order.
"""

from __future__ import annotations

import functools
from typing import Any

import torch
from torch import Tensor

from cat3d_core.zipnerf.grid_layout import GridLayout

try:
    import triton
    import triton.language as tl
except ImportError:  # CPU builds of torch come without it
    triton = None

_BLOCK = 128
# The largest gradient becomes 2^34: 2^28 such terms fit an int64, and the steps are finer than float32's.
_FIXED_POINT_BITS = 34


def available() -> bool:
    """Whether Triton is installed."""
    return triton is not None


if triton is not None:

    @triton.jit
    def _corner(x, y, z, fx, fy, fz, n, rows, hashed, DX: tl.constexpr, DY: tl.constexpr, DZ: tl.constexpr):
        """Row in the level and trilinear share of one corner of cells (x, y, z); share 0 outside a dense level."""
        cx, cy, cz = x + DX, y + DY, z + DZ
        share = (fx if DX else 1.0 - fx) * (fy if DY else 1.0 - fy) * (fz if DZ else 1.0 - fz)
        if hashed:
            mixed = cx.to(tl.uint32, bitcast=True)
            mixed ^= cy.to(tl.uint32, bitcast=True) * 2654435761
            mixed ^= cz.to(tl.uint32, bitcast=True) * 805459861
            row = (mixed & (rows - 1).to(tl.uint32)).to(tl.int64)
        else:
            inside = (cx >= 0) & (cx < n) & (cy >= 0) & (cy < n) & (cz >= 0) & (cz < n)
            row = tl.where(inside, cx + n * (cy + n * cz), 0).to(tl.int64)
            share = tl.where(inside, share, 0.0)
        return row, share

    @triton.jit
    def _sample(positions, std, index, valid, n, hashed):  # type: ignore[no-untyped-def]
        """Cell, fraction and level weight of samples (one number per interval of the block)."""
        size = n.to(tl.float32)
        x = tl.load(positions + index * 3, mask=valid, other=0.5) * size - 0.5
        y = tl.load(positions + index * 3 + 1, mask=valid, other=0.5) * size - 0.5
        z = tl.load(positions + index * 3 + 2, mask=valid, other=0.5) * size - 0.5
        sigma = tl.load(std + index, mask=valid, other=1.0)
        weight = tl.erf(1.0 / tl.maximum(2.8284271247461903 * sigma * size, 1e-12))
        # Far outside points are pulled nearer (on dense levels still to a wholly invalid cell): no overflow in
        # conversion.
        reach = tl.where(hashed, 1e6, 2.0)
        x = tl.minimum(tl.maximum(x, -reach), size + reach)
        y = tl.minimum(tl.maximum(y, -reach), size + reach)
        z = tl.minimum(tl.maximum(z, -reach), size + reach)
        cx, cy, cz = tl.floor(x), tl.floor(y), tl.floor(z)
        return cx.to(tl.int32), cy.to(tl.int32), cz.to(tl.int32), x - cx, y - cy, z - cz, weight

    @triton.jit
    def _forward(  # type: ignore[no-untyped-def]
        table, positions, std, levels, features, weights, intervals,
        LEVELS: tl.constexpr, S: tl.constexpr, F: tl.constexpr, BLOCK: tl.constexpr,
    ):  # fmt: skip
        level = tl.program_id(1)
        start = tl.load(levels + 4 * level)
        n = tl.load(levels + 4 * level + 1).to(tl.int32)
        rows = tl.load(levels + 4 * level + 2)
        hashed = tl.load(levels + 4 * level + 3) != 0
        interval = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
        valid = interval < intervals
        column = tl.arange(0, F)
        total = tl.zeros((BLOCK, F), tl.float32)
        total_weight = tl.zeros((BLOCK,), tl.float32)
        for s in range(S):
            x, y, z, fx, fy, fz, weight = _sample(positions, std, interval * S + s, valid, n, hashed)
            total_weight += weight
            for corner in tl.static_range(8):
                row, share = _corner(x, y, z, fx, fy, fz, n, rows, hashed, corner & 1, (corner >> 1) & 1, corner >> 2)
                value = tl.load(table + (start + row)[:, None] * F + column[None, :], mask=valid[:, None], other=0.0)
                total += (share * weight)[:, None] * value
        out = (interval * LEVELS + level)[:, None] * F + column[None, :]
        tl.store(features + out, total / S, mask=valid[:, None])
        tl.store(weights + interval * LEVELS + level, total_weight / S, mask=valid)

    @triton.jit
    def _backward(  # type: ignore[no-untyped-def]
        gradient, positions, std, levels, target, scale, intervals,
        LEVELS: tl.constexpr, S: tl.constexpr, F: tl.constexpr, BLOCK: tl.constexpr, FIXED: tl.constexpr,
    ):  # fmt: skip
        level = tl.program_id(1)
        start = tl.load(levels + 4 * level)
        n = tl.load(levels + 4 * level + 1).to(tl.int32)
        rows = tl.load(levels + 4 * level + 2)
        hashed = tl.load(levels + 4 * level + 3) != 0
        interval = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
        valid = interval < intervals
        column = tl.arange(0, F)
        source = (interval * LEVELS + level)[:, None] * F + column[None, :]
        g = tl.load(gradient + source, mask=valid[:, None], other=0.0) / S
        if FIXED:
            g *= tl.load(scale)
        wanted = valid[:, None] & (g != 0)  # NaN counts as wanted: it has to reach the table's gradient
        for s in range(S):
            x, y, z, fx, fy, fz, weight = _sample(positions, std, interval * S + s, valid, n, hashed)
            for corner in tl.static_range(8):
                row, share = _corner(x, y, z, fx, fy, fz, n, rows, hashed, corner & 1, (corner >> 1) & 1, corner >> 2)
                term = (share * weight)[:, None] * g
                place = target + (start + row)[:, None] * F + column[None, :]
                if FIXED:
                    tl.atomic_add(place, tl.floor(term + 0.5).to(tl.int64), mask=wanted, sem="relaxed")
                else:
                    tl.atomic_add(place, term, mask=wanted, sem="relaxed")


@functools.cache
def _levels(layout: GridLayout, device: torch.device) -> Tensor:
    rows = [
        (layout.offsets[level], n, layout.offsets[level + 1] - layout.offsets[level], int(layout.hashed(level)))
        for level, n in enumerate(layout.resolutions)
    ]
    return torch.tensor(rows, dtype=torch.int64, device=device)


def _table_gradient(gradient: Tensor, positions: Tensor, std: Tensor, layout: GridLayout) -> Tensor:
    intervals, samples = std.shape
    fixed = torch.are_deterministic_algorithms_enabled()
    scale = torch.ones((), device=gradient.device)
    if fixed:
        # A power of two, so that scaling is exact. A non-finite gradient has no fixed-point form: it marks the table.
        largest = gradient.abs().max()
        if not torch.isfinite(largest):
            return gradient.new_full((layout.rows, layout.features), torch.nan)
        exponent = torch.floor(torch.log2(largest.clamp_min(torch.finfo(torch.float32).tiny)))
        scale = torch.exp2((_FIXED_POINT_BITS - exponent).clamp_max(127.0))
    dtype = torch.int64 if fixed else torch.float32
    target = torch.zeros((layout.rows, layout.features), dtype=dtype, device=gradient.device)
    _backward[(triton.cdiv(intervals, _BLOCK), layout.levels)](
        gradient, positions, std, _levels(layout, gradient.device), target, scale, intervals,
        LEVELS=layout.levels, S=samples, F=layout.features, BLOCK=_BLOCK, FIXED=fixed,
    )  # fmt: skip
    return (target.double() / scale).float() if fixed else target


class _Query(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, table: Tensor, positions: Tensor, std: Tensor, layout: GridLayout) -> Tensor:
        table, positions, std = table.contiguous(), positions.contiguous(), std.contiguous()
        intervals, samples = std.shape
        features = table.new_empty((intervals, layout.levels, layout.features))
        weights = table.new_empty((intervals, layout.levels))
        _forward[(triton.cdiv(intervals, _BLOCK), layout.levels)](
            table, positions, std, _levels(layout, table.device), features, weights, intervals,
            LEVELS=layout.levels, S=samples, F=layout.features, BLOCK=_BLOCK,
        )  # fmt: skip
        ctx.save_for_backward(positions, std)
        ctx.layout = layout
        return torch.cat([features, weights[..., None]], -1)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None, None]:  # type: ignore[override]
        positions, std = ctx.saved_tensors
        return _table_gradient(gradient[..., :-1].contiguous(), positions, std, ctx.layout), None, None, None


def query(table: Tensor, positions: Tensor, std: Tensor, layout: GridLayout) -> Tensor:
    """As `hash_grid.query_reference` for float32 tensors on one GPU; gradient for the table only.

    Raises ValueError for shapes that do not fit the layout (the kernel checks nothing).
    """
    if layout.features & (layout.features - 1):
        raise ValueError(f"The Triton hash grid needs a power of two of features, not {layout.features}.")
    if table.shape != (layout.rows, layout.features) or positions.shape != (*std.shape, 3) or std.ndim != 2:
        raise ValueError(
            f"Expected table {(layout.rows, layout.features)}, positions (N, S, 3) and std (N, S); got "
            f"{tuple(table.shape)}, {tuple(positions.shape)}, {tuple(std.shape)}."
        )
    return _Query.apply(table, positions.detach(), std.detach(), layout)  # type: ignore[no-any-return]
