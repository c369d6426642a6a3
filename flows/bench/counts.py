"""What pieces of work amount to, counted from shapes: see `limits.Work`.

Closed forms for our C++ kernels, which no counter of torch sees; `counted` for what is made of torch's own operations.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, Self

import torch
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from torch.utils.flop_counter import FlopCounterMode

from cat3d_core.cameras import Cameras
from cat3d_core.splats import reference
from cat3d_core.zipnerf import Field
from cat3d_core.zipnerf.grid_layout import GridLayout
from flows.bench.limits import Work

FLOAT = 4  # bytes
#: Of Adam for one parameter: value and both moments read and written, gradient written and read.
ADAM_BYTES, ADAM_FLOPS = 8 * FLOAT, 12
#: Of a Gaussian and a pixel that it covers: offset, quadratic form, exponential, light, four channels and the opacity;
#: backward computes these again, and their derivatives. Of a Gaussian: its projection.
PAIR_FLOPS, PAIR_FLOPS_BACKWARD = 24, 60
PROJECT_FLOPS, PROJECT_FLOPS_BACKWARD = 200, 400
REDUCTIONS = {"sum", "mean", "amax", "amin", "max", "min", "cumsum", "cumprod", "linalg_vector_norm", "prod", "any",
              "all", "argmax", "argmin", "_softmax"}  # fmt: skip


class _Elements(TorchDispatchMode):
    """One operation for each number that an elementwise operation gives, or that a reduction takes."""

    def __init__(self) -> None:
        super().__init__()
        self.flops = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        out = func(*args, **(kwargs or {}))
        if torch.Tag.pointwise in func.tags and not func.is_view:
            self.flops += sum(leaf.numel() for leaf in tree_leaves(out) if _is_float(leaf))
        elif func.overloadpacket.__name__ in REDUCTIONS:
            self.flops += sum(leaf.numel() for leaf in tree_leaves(args) if _is_float(leaf))
        return out


def _is_float(leaf: Any) -> bool:
    return isinstance(leaf, Tensor) and leaf.is_floating_point()


def counted(run: Callable[[], Any]) -> float:
    """Operations of what `run` asks of torch: products and convolutions as torch counts them (a multiplication and an
    addition are two), elementwise operations one a number. Conversions between formats count as one."""
    with FlopCounterMode(display=False) as products, _Elements() as elements:
        run()
    return float(products.get_total_flops() + elements.flops)


def network_bytes(network: nn.Module) -> float:
    """All weights of a network, read once."""
    return float(sum(p.numel() * p.element_size() for p in network.parameters()))


def linear(rows: int, layer: nn.Linear, backward: bool = False) -> Work:
    """A layer on so many rows; backward: the gradients of its weights and of its input too."""
    return Work(2.0 * rows * layer.in_features * layer.out_features * (3 if backward else 1))


def grid_query(layout: GridLayout, intervals: int, samples: int, phase: str = "forward") -> Work:
    """A query of the hash grid for intervals with so many samples each, phase "forward" or "backward".

    A corner is three products (its weight) and F multiplications and additions. Read: positions and spreads, of each
    level's rows at most as many as there are intervals; written: features and weights. Backward: the gradient is read,
    and that of the whole table written.
    """
    flops = float(intervals * samples * layout.levels * 8 * (3 + 2 * layout.features))
    given = intervals * samples * 4 * FLOAT
    if phase == "backward":
        return Work(flops, given + FLOAT * layout.features * (intervals * layout.levels + layout.rows))
    made = intervals * layout.levels * (layout.features + 1) * FLOAT
    return Work(flops, given + made + table_bytes(layout, intervals))


def table_bytes(layout: GridLayout, intervals: int) -> float:
    """What a query reads of the table at least."""
    levels = zip(layout.offsets[:-1], layout.offsets[1:], strict=True)
    return float(FLOAT * layout.features * sum(min(last - first, intervals) for first, last in levels))


class FieldCount:
    """While it is entered, adds up what is asked of a field's grids and networks: `flops`, with the backward pass where
    gradients are wanted, and `intervals` that were queried. Sampling and compositing are not counted."""

    def __init__(self, field: Field) -> None:
        self.field, self.flops, self.intervals = field, 0.0, 0

    def __enter__(self) -> Self:
        grids = [grid.register_forward_hook(self._grid) for grid in self.field.grids]
        self.handles = [*grids, self.field.colour.register_forward_hook(self._colour)]
        return self

    def __exit__(self, *_: object) -> None:
        for handle in self.handles:
            handle.remove()

    def _grid(self, grid: Any, inputs: tuple[Tensor, Tensor], _out: Any) -> None:
        rays, intervals, samples = inputs[1].shape
        count, backward = rays * intervals, torch.is_grad_enabled()
        self.intervals += count
        self.flops += grid_query(grid.layout, count, samples).flops * (2 if backward else 1)
        self.flops += sum(linear(count, layer, backward).flops for layer in (grid.hidden, grid.density))

    def _colour(self, colour: Any, inputs: tuple[Tensor, Tensor], _out: Any) -> None:
        (rays, intervals), backward = inputs[0].shape[:2], torch.is_grad_enabled()
        for layer in (colour.bottleneck, *colour.layers, colour.rgb):
            self.flops += linear(rays * intervals, layer, backward).flops
        if not colour.skip:  # the first layer's part for the direction is the same for all intervals of a ray
            directions = 3 + 6 * colour.degree
            each = 2.0 * directions * colour.layers[0].out_features * (3 if backward else 1)
            self.flops -= each * rays * (intervals - 1)

    def steps(self, count: int) -> Work:
        """The work of one of so many steps of training: with Adam, which visits every parameter."""
        parameters = sum(p.numel() for p in self.field.parameters())
        return Work(self.flops / count + ADAM_FLOPS * parameters, float(ADAM_BYTES * parameters))

    def images(self, count: int, pixels: int) -> Work:
        """The work of one of so many images: tables and networks are read, five numbers a pixel are written."""
        each = math.ceil(self.intervals / count)
        layouts: list[Any] = [grid.layout for grid in self.field.grids]
        tables = sum(table_bytes(layout, each) for layout in layouts)
        return Work(self.flops / count, tables + 5 * FLOAT * pixels)


def covered(projected: reference.Projected, width: int, height: int) -> float:
    """Pairs of a Gaussian and a pixel that it covers (alpha of at least LEAST_ALPHA), by the areas of the ellipses and
    the share of their boxes that lies in the image. What lies behind opaque Gaussians counts too."""
    a, b, c = projected.conic.double().unbind(-1)
    reach = 2 * (projected.opacity.double() / reference.LEAST_ALPHA).clamp_min(1.0).log()
    determinant = a * c - b * b
    area = math.pi * reach / determinant.sqrt()
    shares = []
    for axis, (across, side) in enumerate(((c, width), (a, height))):
        half = (reach * across / determinant).sqrt().clamp_min(1e-9)
        centre = projected.centre[:, axis].double()
        inside = (centre + half).clamp_max(side) - (centre - half).clamp_min(0)
        shares.append((inside / (2 * half)).clamp(0, 1))
    seen = projected.depth > reference.NEAR
    return float((area * shares[0] * shares[1])[seen].sum())


def rasterization(gaussians: Sequence[Tensor], camera: Cameras, phase: str = "forward") -> Work:
    """Drawing Gaussians (means, quaternions, scales, opacities, features) in one camera, phase "forward" or
    "backward". Moved: the Gaussians and the image, backward their gradients too."""
    width, height = (int(side) for side in camera.size[0])
    means, quaternions, scales, opacities, features = gaussians
    with torch.no_grad():
        pairs = covered(reference.project(means, quaternions, scales, opacities, camera), width, height)
    numbers = sum(value.numel() for value in gaussians) + width * height * (features.shape[1] + 1)
    count = len(means)
    if phase == "backward":
        return Work(pairs * PAIR_FLOPS_BACKWARD + count * PROJECT_FLOPS_BACKWARD, float(2 * FLOAT * numbers))
    return Work(pairs * PAIR_FLOPS + count * PROJECT_FLOPS, float(FLOAT * numbers))


def psnr(values: int) -> Work:
    """Two images of so many numbers: difference, square, sum."""
    return Work(3.0 * values, 2.0 * FLOAT * values)


def ssim(values: int, taps: int) -> Work:
    """Two images of so many numbers with a separable window: four local means (cat3d_core/metrics/ssim.py) of two
    passes each, and some 16 operations around them."""
    return Work(values * (4 * 2 * (2 * taps - 1) + 16.0), 2.0 * FLOAT * values)
