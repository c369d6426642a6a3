"""Intersections against closed forms and against the surface's own equation, in float64."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from cat3d_core.synthetic import intersect

F64 = torch.float64
numbers = st.floats(-1, 1, width=32)


def rays_towards_origin(seed: int, count: int = 200) -> tuple[torch.Tensor, torch.Tensor]:
    """Origins outside the unit shapes, directions towards a point of the cube [-1.2, 1.2]^3: (3, R) each, float64."""
    random = torch.Generator().manual_seed(seed)
    origin = torch.randn(3, count, generator=random, dtype=F64)
    origin = 4 * origin / origin.norm(dim=0)
    target = (torch.rand(3, count, generator=random, dtype=F64) - 0.5) * 2.4
    length = 0.2 + 3 * torch.rand(count, generator=random, dtype=F64)
    return origin, (target - origin) * length


def sphere_reference(o, d):
    a, b, c = (d * d).sum(0), (o * d).sum(0), (o * o).sum(0) - 1
    disc = b * b - a * c
    return torch.where(disc > 0, (-b - disc.clamp(min=0).sqrt()) / a, torch.inf)


@pytest.mark.parametrize("seed", range(5))
def test_sphere_is_the_quadratic_formula(seed):
    o, d = rays_towards_origin(seed)
    torch.testing.assert_close(intersect.sphere(o, d), sphere_reference(o, d), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(("shape", "inside"), [
    (intersect.sphere, lambda p: p.norm(dim=0)),
    (intersect.box, lambda p: p.abs().amax(0)),
    (intersect.cylinder, lambda p: torch.maximum(p[:2].norm(dim=0), p[2].abs())),
])  # fmt: skip
@pytest.mark.parametrize("seed", range(5))
def test_hits_lie_on_the_surface_and_nothing_lies_before_them(shape, inside, seed):
    o, d = rays_towards_origin(seed)
    t = shape(o, d)
    hit = t.isfinite()
    assert 0.2 < hit.double().mean() < 1
    torch.testing.assert_close(inside(o + t * d)[hit], torch.ones(int(hit.sum()), dtype=F64), rtol=1e-9, atol=1e-9)
    for share in torch.linspace(0, 0.999, 50):
        assert (inside(o[:, hit] + share * t[hit] * d[:, hit]) > 1 - 1e-9).all()
    # What is called a miss passes outside, sampled densely.
    miss_o, miss_d = o[:, ~hit], d[:, ~hit]
    for step in torch.linspace(0, 40, 2001):
        assert (inside(miss_o + step * miss_d) > 0.999).all()


@given(numbers, numbers, numbers, st.floats(0, 6.28), st.floats(-1.5, 1.5))
@settings(max_examples=60, deadline=None)
def test_room_is_left_through_its_wall(x, y, z, azimuth, elevation):
    o = 0.99 * torch.tensor([[x], [y], [z]], dtype=F64)
    flat = math.cos(elevation)
    d = torch.tensor([[math.cos(azimuth) * flat], [math.sin(azimuth) * flat], [math.sin(elevation)]], dtype=F64)
    t = intersect.room(o, d)
    assert t > 0
    assert abs(float((o + t * d).abs().max()) - 1) < 1e-9


def test_axis_parallel_rays():
    """Directions with exact zeros, along the faces' normals: t = 3 - 1 from three units away."""
    for axis in range(3):
        o, d = torch.zeros(3, 1, dtype=F64), torch.zeros(3, 1, dtype=F64)
        o[axis], d[axis] = 3, -1
        for shape in (intersect.sphere, intersect.box, intersect.cylinder):
            assert float(shape(o, d)) == pytest.approx(2, abs=1e-9)
        o[(axis + 1) % 3] = 1.5
        for shape in (intersect.sphere, intersect.box, intersect.cylinder):
            assert torch.isinf(shape(o, d)).all()


def test_level_ground_is_a_plane():
    waves, flat = torch.zeros(1, 2, 4, dtype=F64), torch.ones(1, dtype=F64)
    o = torch.tensor([[[0.3], [0.1], [2.0]]], dtype=F64)
    d = torch.tensor([[[0.5], [0.2], [-0.8]]], dtype=F64)
    assert float(intersect.ground(waves, flat, o, d)) == pytest.approx(2.5, abs=1e-12)
    assert torch.isinf(intersect.ground(waves, flat, o, -d)).all()


def hills(dtype=F64) -> tuple[torch.Tensor, torch.Tensor]:
    waves = torch.tensor([[[0.5, 0.2, 0.3, 0.15], [-0.3, 0.7, 1.0, 0.1], [0.9, -0.6, 2.0, 0.05]]], dtype=dtype)
    return waves, torch.tensor([1.5], dtype=dtype)


@pytest.mark.parametrize(("dtype", "tolerance"), [(F64, 1e-9), (torch.float32, 2e-4)])
def test_hills_hits_satisfy_the_equation(dtype, tolerance):
    waves, flat = hills(dtype)
    random = torch.Generator().manual_seed(0)
    o = torch.tensor([0.0, 0.0, 1.2], dtype=dtype)[None, :, None].expand(1, 3, 2000)
    d = torch.randn(1, 3, 2000, generator=random, dtype=F64).to(dtype)
    d[:, 2] = -d[:, 2].abs() - 0.15
    t = intersect.ground(waves, flat, o, d)
    assert t.isfinite().double().mean() > 0.99
    hit = t[0].isfinite()
    p = (o + t[:, None] * d)[:, :, hit]
    residual = (p[:, 2] - intersect.ground_height(waves, flat, p[:, :2])).abs() / (1 + t[:, hit])
    assert residual.quantile(0.99) < tolerance
    assert residual.max() < 1e-3  # the rest grazes a crest
    # First hit: the ray stays above the ground before it.
    for share in torch.linspace(0.02, 0.98, 49):
        q = o[:, :, hit] + share * t[:, None, hit] * d[:, :, hit]
        assert (q[:, 2] - intersect.ground_height(waves, flat, q[:, :2]) > -1e-3).double().mean() > 0.999


def test_ground_gradient_is_the_derivative_of_the_height():
    waves, flat = hills()
    xy = (4 * torch.randn(1, 2, 50, dtype=F64, generator=torch.Generator().manual_seed(1))).requires_grad_()
    height = intersect.ground_height(waves, flat, xy)
    (numeric,) = torch.autograd.grad(height.sum(), xy)
    torch.testing.assert_close(intersect.ground_gradient(waves, flat, xy.detach()), numeric, rtol=1e-10, atol=1e-12)
