"""The kernels along rays against their references in float64, slopes and odd rays included."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from cat3d_core.cpu_library import library
from cat3d_core.zipnerf import ray_intervals, stepfun

needs_compiler = pytest.mark.skipif(library("zipnerf/ray_intervals") is None, reason="There is no C++ compiler here.")


def _histogram(rays: int, bins: int, seed: int) -> tuple[Tensor, Tensor]:
    """Edges, some without a bin between them, and weights; some rays have none."""
    draw = torch.Generator().manual_seed(seed)
    t = torch.rand(rays, bins + 1, generator=draw).sort(-1).values
    t[:, 3] = t[:, 2]
    w = torch.rand(rays, bins, generator=draw) ** 4
    w = w / w.sum(-1, keepdim=True)
    w[::7] = 0
    return t, w


@needs_compiler
@pytest.mark.parametrize(("bins", "count"), [(2, 2), (12, 16), (33, 7), (128, 128)])
def test_drawn_intervals_split_the_weight_evenly(bins: int, count: int) -> None:
    draw = torch.Generator().manual_seed(0)
    t = torch.linspace(0, 1, bins + 1).expand(50, -1)
    logits = torch.randn(50, bins, generator=draw)
    for generator in (None, torch.Generator().manual_seed(1)):
        state = None if generator is None else generator.get_state()
        own = ray_intervals.sample_intervals(t, logits, count, generator)
        if generator is not None:
            generator.set_state(state)
        u = stepfun.stratified(t, count, generator).expand(50, count)
        centre = stepfun.invert_cdf(u.double(), t.double(), logits.double())
        middle = 0.5 * (centre[:, 1:] + centre[:, :-1])
        torch.testing.assert_close(own[:, 1:-1].double(), middle, rtol=0, atol=2e-6)
        first, last = 2 * centre[:, 0] - middle[:, 0], 2 * centre[:, -1] - middle[:, -1]
        torch.testing.assert_close(own[:, 0].double(), first.clamp(min=0), rtol=0, atol=4e-6)
        torch.testing.assert_close(own[:, -1].double(), last.clamp(max=1), rtol=0, atol=4e-6)


@needs_compiler
def test_drawn_intervals_of_odd_rays() -> None:
    t, w = _histogram(70, 20, 0)
    edges = ray_intervals.sample_intervals(t, w.clamp_min(1e-38).log(), 16)
    assert bool((edges.diff(dim=-1) >= 0).all())
    assert float(edges.min()) >= 0
    assert float(edges.max()) <= 1
    broken = w.log().clone()
    broken[5, 4] = torch.nan
    assert bool(ray_intervals.sample_intervals(t, broken, 16)[5].isnan().all())


@needs_compiler
def test_weights_take_light_from_what_lies_behind() -> None:
    draw = torch.Generator().manual_seed(0)
    density = (10 ** (torch.rand(200, 32, generator=draw) * 12 - 8)).requires_grad_()
    lengths = torch.rand(200, 32, generator=draw)
    exact = density.detach().double().requires_grad_()
    own, reference = ray_intervals.weights(density, lengths), ray_intervals.weights_reference(exact, lengths.double())
    torch.testing.assert_close(own.double(), reference, rtol=3e-5, atol=1e-30)
    gradient = torch.randn(200, 32, generator=draw)
    (slope,) = torch.autograd.grad(own, density, gradient)
    (expected,) = torch.autograd.grad(reference, exact, gradient.double())
    torch.testing.assert_close(slope.double(), expected, rtol=1e-4, atol=1e-6)


@needs_compiler
def test_interlevel_and_distortion() -> None:
    (t, w), (final_t, final_w) = _histogram(140, 32, 0), _histogram(140, 16, 1)
    leaf, exact = w.clone().requires_grad_(), w.double().requires_grad_()
    # Its reference in float64 is that of `cat3d stress`; here that kernel and torch have the same slope.
    own, by_torch = (
        function(t, leaf, final_t, final_w, 0.03)
        for function in (ray_intervals.interlevel, ray_intervals.interlevel_reference)
    )
    torch.testing.assert_close(own, by_torch, rtol=1e-5, atol=0)
    (slope,), (expected,) = (torch.autograd.grad(loss, leaf) for loss in (own, by_torch))
    torch.testing.assert_close(slope, expected, rtol=2e-4, atol=1e-6)
    values = ray_intervals.distortion(t, leaf)
    expected_values = stepfun.distortion(t.double(), exact)
    torch.testing.assert_close(values.double(), expected_values, rtol=1e-6, atol=1e-12)
    (slope,) = torch.autograd.grad(values.sum(), leaf)
    (expected,) = torch.autograd.grad(expected_values.sum(), exact)
    torch.testing.assert_close(slope.double(), expected, rtol=1e-5, atol=1e-7)


def test_long_rays_go_by_torch() -> None:
    t = torch.linspace(0, 1, 200).expand(3, -1)
    w = torch.full((3, 199), 1 / 199)
    assert ray_intervals.kernels_for(t, w) is None
    torch.testing.assert_close(ray_intervals.distortion(t, w), stepfun.distortion(t, w))
