"""What is stressed: a routine of the core, what it is compared with, and how far off it may be."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from cat3d_core.stress.draw import Draw

SINGLE, DOUBLE, HALF, BRAIN = torch.float32, torch.float64, torch.float16, torch.bfloat16


class Exact(NamedTuple):
    """A reference value and the size that errors are relative to (broadcasts to the value). Where a result means
    nothing (pixels behind a camera) the scale is infinite: it only has to be finite."""

    value: Tensor
    scale: Tensor


Bounds = dict[torch.dtype, float]
# Some 16 roundings: what a handful of operations may lose, and nothing that cancels.
ROUNDING: Bounds = {DOUBLE: 4e-15, SINGLE: 2e-6}
Inputs = Callable[[Draw], tuple[Tensor, ...]]
Call = Callable[..., Tensor]
Reference = Callable[..., Tensor | Exact]


@dataclass(frozen=True)
class Routine:
    """One row of the table.

    inputs: draws a batch of cases, tensors with the cases along axis 0, float64 (rounded to the dtype under test; whole
        numbers and booleans stay). call: the routine, in that dtype. reference: the same from the rounded inputs in
        float64, by another formula; a tensor, or `Exact` where the error is not relative to each element.
    bounds: largest relative error allowed for each dtype that is claimed. gradients: the same for the derivative of a
        weighted sum of the outputs with respect to the inputs numbered in `wrt`, relative to the case's largest
        derivative in that input, or to `gradient_scale` of the inputs where parts of a derivative cancel (one tensor
        for each of `wrt`). The reference is differentiated by autograd in float64.
    floor: sizes below floor count as floor (default: the dtype's smallest normal number, where relative accuracy ends).
    share: multiplies the number of cases; small for slow routines. chunk: cases in one call.
    claim: what is promised, in words.
    """

    name: str
    claim: str
    inputs: Inputs
    call: Call
    reference: Reference
    bounds: Bounds
    gradients: Bounds | None = None
    wrt: tuple[int, ...] = (0,)
    gradient_scale: Callable[..., tuple[Tensor, ...]] | None = None
    floor: float | None = None
    share: float = 1.0
    chunk: int = 4096


def each(function: Call) -> Call:
    """A routine of one case as a batched one; zero cases give an empty tensor."""

    def batched(*inputs: Tensor) -> Tensor:
        rows = [function(*row) for row in zip(*inputs, strict=True)]
        return torch.stack(rows) if rows else inputs[0].new_zeros(0)

    return batched


def zero(*_: Tensor) -> Exact:
    """Reference of a call that measures its own error: zero, in units of 1."""
    return Exact(torch.zeros((), dtype=torch.float64), torch.ones((), dtype=torch.float64))
