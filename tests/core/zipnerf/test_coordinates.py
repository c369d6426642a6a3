"""Contraction and ray distance against float64 and mpmath, with gradients, over all magnitudes."""

import math

import mpmath
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from cat3d_core.zipnerf.coordinates import (
    contract,
    contracted_std,
    inverse_power_ladder,
    power_ladder,
    s_from_t,
    t_from_s,
)


def _points(count: int = 4000) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    direction = torch.nn.functional.normalize(torch.randn((count, 3), generator=generator), dim=-1)
    return direction * 10 ** torch.linspace(-12, 9, count)[:, None]


def test_contraction_is_the_identity_inside_and_stays_in_the_ball() -> None:
    x = _points()
    y = contract(x)
    inside = x.norm(dim=-1) < 0.999
    assert torch.equal(y[inside], x[inside])
    assert (y.norm(dim=-1) <= 2.0 + 1e-6).all()
    reference = contract(x.double())
    torch.testing.assert_close(y.double(), reference, rtol=1e-6, atol=0)  # float32


def test_contraction_gradient_is_finite_and_right() -> None:
    x = torch.cat([torch.zeros(1, 3), _points()]).requires_grad_()
    contract(x).square().sum().backward()
    assert x.grad is not None
    assert torch.isfinite(x.grad).all()
    points = (torch.randn((20, 3), dtype=torch.float64) * 3).requires_grad_()
    assert torch.autograd.gradcheck(contract, (points,))


def test_contracted_std_is_the_determinant_of_the_jacobian() -> None:
    x = torch.randn((50, 3), dtype=torch.float64) * 4
    for point in x:
        jacobian = torch.autograd.functional.jacobian(contract, point)
        expected = torch.linalg.det(jacobian).abs() ** (1 / 3)  # type: ignore[operator]
        torch.testing.assert_close(
            contracted_std(point, torch.ones((), dtype=torch.float64)), expected, rtol=1e-9, atol=0
        )


@pytest.mark.parametrize("p", [-1.5, -0.25, 0.0, 0.5, 1.0, -math.inf])
@pytest.mark.parametrize("premult", [1.0, 2.0, 1e4])
def test_power_ladder_matches_its_definition(p: float, premult: float) -> None:
    x = 10 ** torch.linspace(-10, 6, 200)
    got = power_ladder(x, p, premult)
    with mpmath.workdps(40):

        def exact(value: float) -> float:
            scaled = mpmath.mpf(value) * premult
            if p == 1.0:
                return float(scaled)
            if p == 0.0:
                return float(mpmath.log1p(scaled))
            if p == -math.inf:
                return float(1 - mpmath.exp(-scaled))
            c = abs(mpmath.mpf(p) - 1)
            return float(c / p * ((scaled / c + 1) ** p - 1))

        expected = torch.tensor([exact(float(v)) for v in x], dtype=torch.float64)
    torch.testing.assert_close(got.double(), expected, rtol=1e-6, atol=0)
    if p == -math.inf:
        return
    round_trip = inverse_power_ladder(power_ladder(x.double(), p, premult), p, premult)
    moderate = x < 10
    torch.testing.assert_close(round_trip[moderate], x.double()[moderate], rtol=1e-5 if premult > 10 else 1e-7, atol=0)


@pytest.mark.parametrize(("near", "far"), [(0.0, 1e6), (0.05, 1e6), (0.2, 10.0), (0.0, 1.0)])
@pytest.mark.parametrize("p", [-1.5, -0.25, 0.0, 0.5, 1.0])
def test_distance_is_accurate_in_float32(near: float, far: float, p: float) -> None:
    tail = torch.tensor([0.25, 0.5, 1.0]) / 2**21
    s = torch.cat([10 ** torch.linspace(-12, -0.31, 300), torch.linspace(0, 1, 301), 1 - tail])
    got = t_from_s(s, near, far, p, 2.0)

    def exact(value: float) -> float:
        q = mpmath.mpf(p)
        if p == 1.0:
            return float(near + mpmath.mpf(value) * (mpmath.mpf(far) - near))
        c = abs(q - 1) / 2

        def ladder(t: float) -> mpmath.mpf:
            return mpmath.log1p(t / c) if p == 0.0 else (1 + t / c) ** q

        mixed = ladder(near) * (1 - mpmath.mpf(value)) + ladder(far) * mpmath.mpf(value)
        return float(c * (mpmath.expm1(mixed) if p == 0.0 else mixed ** (1 / q) - 1))

    with mpmath.workdps(50):
        near, far = mpmath.mpf(near), mpmath.mpf(far)
        expected = torch.tensor([exact(float(v)) for v in s], dtype=torch.float64)
    torch.testing.assert_close(got.double(), expected, rtol=2e-6, atol=1e-37)
    assert got[s == 1].double() == pytest.approx(float(far), rel=2e-6)


@settings(deadline=None, max_examples=60)
@given(st.floats(0, 1), st.sampled_from([-1.5, -0.25, 0.0, 0.5, 1.0]), st.sampled_from([0.0, 0.1]))
def test_distance_round_trip(s: float, p: float, near: float) -> None:
    value = torch.tensor([s], dtype=torch.float64)
    again = s_from_t(t_from_s(value, near, 1e6, p), near, 1e6, p)
    torch.testing.assert_close(again, value, rtol=1e-9, atol=1e-12)


def test_distance_gradient_is_finite() -> None:
    s = torch.cat([torch.zeros(1), 10 ** torch.linspace(-12, 0, 200)]).requires_grad_()
    t_from_s(s, 0.0, 1e6).log1p().sum().backward()
    assert s.grad is not None
    assert torch.isfinite(s.grad).all()
    assert (s.grad > 0).all()


def test_wrong_ranges_are_refused() -> None:
    with pytest.raises(ValueError, match="near < far"):
        t_from_s(torch.zeros(1), 2.0, 1.0)
    with pytest.raises(ValueError, match="power p"):
        t_from_s(torch.zeros(1), 0.0, 1.0, 2.0)
