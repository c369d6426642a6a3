"""The narrow layers of the field, one after the other: `chain_reference` in torch, and a C++ kernel (layers.cpp)."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from cat3d_core.cpu_library import library, pointer

#: Most inputs or outputs of a layer, and most layers, of the kernel.
WIDEST, LONGEST = 64, 4


class Layer(NamedTuple):
    """y = f(x weightᵀ + added) of rows x (M, K): weight (J, K), f is max(0, .) if `relu`, else nothing.

    added (G, J): a bias for each of G groups of M / G rows that follow each other; (1, J) is the usual bias. What is
    the same for all intervals of a ray (its direction) is multiplied once a ray and comes in here.
    """

    weight: Tensor
    added: Tensor
    relu: bool = False


def chain_reference(x: Tensor, layers: Sequence[Layer]) -> list[Tensor]:
    """The outputs of all layers, each of which reads the one before it; the first reads x (M, K)."""
    out = []
    for weight, added, relu in layers:
        x = (functional.linear(x, weight).view(len(added), -1, len(weight)) + added[:, None]).view(-1, len(weight))
        x = torch.relu(x) if relu else x
        out.append(x)
    return out


def _pointers(tensors: Sequence[Tensor | None]) -> Any:
    return (ctypes.c_void_p * len(tensors))(*(pointer(tensor) for tensor in tensors))


def _chain(x: Tensor, weights: Sequence[Tensor], added: Sequence[Tensor], relus: Sequence[bool]) -> tuple[Any, ...]:
    """The kernel's arguments that say what the chain is."""
    shape = [
        value
        for weight, add, relu in zip(weights, added, relus, strict=True)
        for value in (weight.shape[1], weight.shape[0], int(relu), len(x) // len(add))
    ]
    counts = ctypes.c_int(len(weights)), (ctypes.c_int64 * len(shape))(*shape)
    return pointer(x), *counts, _pointers(weights), _pointers(added)


class _Chain(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, relus: tuple[bool, ...], shown: tuple[bool, ...], *both: Tensor) -> Any:
        x, both = x.contiguous(), tuple(tensor.contiguous() for tensor in both)
        weights, added = both[: len(relus)], both[len(relus) :]
        out = [x.new_empty((len(x), len(w))) if show else None for w, show in zip(weights, shown, strict=True)]
        _kernels().chain_forward(*_chain(x, weights, added, relus), _pointers(out), *_size(x))
        ctx.save_for_backward(x, *both)
        ctx.relus, ctx.shown = relus, shown
        return tuple(value for value in out if value is not None)

    @staticmethod
    def backward(ctx: Any, *given: Tensor) -> Any:
        x, *both = ctx.saved_tensors
        weights, added = both[: len(ctx.relus)], both[len(ctx.relus) :]
        left = iter(given)
        gradients = [next(left).contiguous() if show else None for show in ctx.shown]
        slopes = [torch.empty_like(tensor) for tensor in (x, *both)]
        _kernels().chain_backward(
            *_chain(x, weights, added, ctx.relus), _pointers(gradients), pointer(slopes[0]),
            _pointers(slopes[1 : 1 + len(weights)]), _pointers(slopes[1 + len(weights) :]), *_size(x),
        )  # fmt: skip
        return slopes[0], None, None, *slopes[1:]


def _kernels() -> ctypes.CDLL:
    kernels = library("zipnerf/layers")
    assert kernels is not None
    return kernels


def _size(x: Tensor) -> tuple[Any, ...]:
    return ctypes.c_int64(len(x)), ctypes.c_int(torch.get_num_threads())


def chain(x: Tensor, layers: Sequence[Layer], shown: Sequence[bool]) -> list[Tensor]:
    """Those outputs of `chain_reference` that are `shown`, by the kernel for float32 on the CPU where a compiler is
    found and all layers are narrow.

    The kernel writes nothing else to memory, and computes it again for gradients. With the same number of threads it
    gives the same bits. Raises ValueError where shapes do not go together.
    """
    inputs = x.shape[1:]
    for weight, added, _ in layers:
        if x.ndim != 2 or weight.shape[1:] != inputs or added.shape[1:] != weight.shape[:1] or not len(added):
            raise ValueError(
                f"Expected x (M, K), weights (J, K) and added (G, J); one weight is {tuple(weight.shape)}, with added "
                f"{tuple(added.shape)}, on {tuple(inputs)} inputs."
            )
        if len(x) % len(added):
            raise ValueError(f"{len(x)} rows are not {len(added)} groups of one size.")
        inputs = weight.shape[:1]
    narrow = max(max(layer.weight.shape) for layer in layers) <= WIDEST and len(layers) <= LONGEST
    kernel = x.dtype == torch.float32 and x.device.type == "cpu" and narrow and len(x) > 0
    if not kernel or library("zipnerf/layers") is None:
        return [out for out, show in zip(chain_reference(x, layers), shown, strict=True) if show]
    both = [layer.weight for layer in layers] + [layer.added for layer in layers]
    return list(_Chain.apply(x, tuple(layer.relu for layer in layers), tuple(shown), *both))
