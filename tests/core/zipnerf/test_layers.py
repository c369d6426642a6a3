"""Chains of narrow layers: the kernel against the reference in float64, for every shape and number of threads."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from cat3d_core.cpu_library import library
from cat3d_core.zipnerf.layers import Layer, chain, chain_reference

needs_compiler = pytest.mark.skipif(library("zipnerf/layers") is None, reason="There is no C++ compiler here.")

#: Rows, widths, groups of each layer, relus, which outputs are shown.
CHAINS = {
    "density": (203, (8, 32, 1), (1, 1), (True, False), (True, True)),
    "colour": (336, (32, 16, 32, 3), (1, 21, 1), (False, True, False), (False, False, True)),
    "all kinds": (1200, (35, 17, 64, 40, 3), (1, 12, 1, 12), (True, True, True, False), (True, False, True, True)),
    "groups larger than a chunk": (600, (5, 64), (2,), (True,), (True,)),
    "a group for each row": (77, (3, 5), (77,), (True,), (True,)),
    "one row": (1, (64, 2), (1,), (False,), (True,)),
}


def _run(name: str, dtype: torch.dtype, reference: bool = False) -> list[Tensor]:
    """Outputs shown, then slopes of rows, weights and what is added, of the same numbers for every dtype."""
    rows, widths, groups, relus, shown = CHAINS[name]
    draw = torch.Generator().manual_seed(0)

    def numbers(*shape: int) -> Tensor:
        return torch.randn(shape, generator=draw).to(dtype)

    x = numbers(rows, widths[0]).requires_grad_()
    weights = [numbers(b, a).requires_grad_() for a, b in zip(widths[:-1], widths[1:], strict=True)]
    added = [numbers(count, width).requires_grad_() for count, width in zip(groups, widths[1:], strict=True)]
    layers = [Layer(*each) for each in zip(weights, added, relus, strict=True)]
    if reference:
        out = [value for value, show in zip(chain_reference(x, layers), shown, strict=True) if show]
    else:
        out = chain(x, layers, shown)
    slopes = torch.autograd.grad(out, [x, *weights, *added], [numbers(*value.shape) for value in out])
    return [*out, *slopes]


@needs_compiler
@pytest.mark.parametrize("name", CHAINS)
def test_kernel_matches_float64(name: str) -> None:
    for own, exact in zip(_run(name, torch.float32), _run(name, torch.float64, reference=True), strict=True):
        assert own.dtype == torch.float32
        torch.testing.assert_close(own.double(), exact, rtol=0, atol=1e-5 * float(exact.detach().abs().max()))


@needs_compiler
def test_same_threads_same_bits() -> None:
    before = torch.get_num_threads()
    try:
        found = {}
        for threads in (1, 2, 2, 1):
            torch.set_num_threads(threads)
            found.setdefault(threads, []).append(_run("all kinds", torch.float32))
    finally:
        torch.set_num_threads(before)
    for first, second in found.values():
        assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))
    outputs = 3
    assert all(torch.equal(a, b) for a, b in zip(found[1][0][:outputs], found[2][0][:outputs], strict=True))


@needs_compiler
def test_what_is_not_finite_stays_so() -> None:
    x = torch.tensor([[1.0, torch.nan], [torch.inf, 1.0], [1.0, 1.0]])
    layers = [Layer(torch.ones(3, 2), torch.zeros(1, 3), True), Layer(torch.ones(1, 3), torch.zeros(1, 1))]
    [out] = chain(x, layers, (False, True))
    assert out[:, 0].tolist()[1:] == [torch.inf, 6.0]
    assert bool(out[0].isnan())


def test_wide_layers_go_by_torch() -> None:
    x, weight = torch.randn(4, 3), torch.randn(65, 3)
    [out] = chain(x, [Layer(weight, torch.zeros(1, 65))], (True,))
    torch.testing.assert_close(out, x @ weight.T)


def test_shapes_that_do_not_go_together() -> None:
    x, weight = torch.ones(4, 3), torch.ones(2, 3)
    with pytest.raises(ValueError, match=r"4 rows are not 3 groups"):
        chain(x, [Layer(weight, torch.ones(3, 2))], (True,))
    with pytest.raises(ValueError, match=r"one weight is \(2, 3\), .* on \(2,\) inputs"):
        chain(x, [Layer(weight, torch.ones(1, 2)), Layer(weight, torch.ones(1, 2))], (True, True))
