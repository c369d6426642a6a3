"""Splines: exact exp/log, through the knots, smooth, no flips, and moving with the world."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from cat3d_core.splines import (
    even_parameters,
    rotation_angle,
    rotation_spline,
    shortest_order,
    so3_exp,
    so3_log,
    vector_spline,
)
from tests.core.strategies import random_rotation, seeds

F64 = torch.float64


def rotations(seed: int, count: int) -> torch.Tensor:
    g = torch.Generator().manual_seed(seed)
    return torch.stack([random_rotation(g) for _ in range(count)])


def turn(axis: tuple[float, float, float], degrees: float) -> torch.Tensor:
    a = torch.tensor(axis, dtype=F64)
    return so3_exp(a / a.norm() * math.radians(degrees))


@given(seeds, st.floats(0, math.pi - 1e-4))
def test_exp_agrees_with_the_matrix_exponential_and_log_inverts_it(seed: int, angle: float) -> None:
    w = torch.randn(3, generator=torch.Generator().manual_seed(seed), dtype=F64)
    w = w / w.norm() * angle
    skew = torch.tensor([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]], dtype=F64)
    assert torch.allclose(so3_exp(w), torch.linalg.matrix_exp(skew), atol=1e-13)
    assert torch.allclose(so3_log(so3_exp(w)), w, atol=1e-10)


@given(seeds)
def test_log_at_a_half_turn_has_length_pi_and_a_fixed_side(seed: int) -> None:
    axis = torch.randn(3, generator=torch.Generator().manual_seed(seed), dtype=F64)
    axis = axis / axis.norm()
    axis = axis if axis[1] > 0 else -axis
    log = so3_log(so3_exp(axis * math.pi))
    assert torch.allclose(log, axis * math.pi, atol=1e-6)
    # Rounding of the size of float32 doesn't change the side.
    assert torch.allclose(so3_log(so3_exp(axis * (math.pi - 1e-6)).float().double()), log, atol=1e-3)


def test_log_of_the_identity_is_zero_and_small_angles_keep_their_digits() -> None:
    assert torch.equal(so3_log(torch.eye(3, dtype=F64)), torch.zeros(3, dtype=F64))
    w = torch.tensor([1e-9, -2e-9, 3e-9], dtype=F64)
    assert torch.allclose(so3_log(so3_exp(w)), w, rtol=1e-6, atol=0)


@given(seeds, st.integers(2, 6))
def test_curves_go_through_their_knots(seed: int, count: int) -> None:
    r = rotations(seed, count)
    g = torch.Generator().manual_seed(seed)
    knots = (0.2 + torch.rand(count, generator=g, dtype=F64)).cumsum(0)
    x = torch.randn(count, 3, generator=g, dtype=F64)
    assert rotation_angle(rotation_spline(knots, r, knots), r).max() < 1e-7
    assert torch.allclose(vector_spline(knots, x, knots), x, atol=1e-12)
    # A little inside each segment's end as well: no jump at the knots.
    assert rotation_angle(rotation_spline(knots, r, knots[1:] - 1e-9), r[1:]).max() < 1e-6


def test_two_knots_give_the_geodesic_and_the_line() -> None:
    a, b = turn((1, 2, 3), 20), turn((1, -1, 0.5), 150)
    knots = torch.tensor([0.0, 2.0], dtype=F64)
    t = torch.linspace(0, 2, 21, dtype=F64)
    curve = rotation_spline(knots, torch.stack([a, b]), t)
    expected = a @ so3_exp(t[:, None] / 2 * so3_log(a.T @ b))
    assert torch.allclose(curve, expected, atol=1e-12)
    x = torch.tensor([[0.0, 1, 2], [4, 1, -2]], dtype=F64)
    assert torch.allclose(vector_spline(knots, x, t), x[0] + t[:, None] / 2 * (x[1] - x[0]), atol=1e-12)


@given(seeds, st.integers(3, 6))
def test_rotation_velocity_is_continuous_at_the_knots(seed: int, count: int) -> None:
    r = rotations(seed, count)
    knots = torch.arange(count, dtype=F64)
    h = 1e-6
    inner = knots[1:-1]
    before = so3_log(rotation_spline(knots, r, inner - h).transpose(1, 2) @ rotation_spline(knots, r, inner)) / h
    after = so3_log(rotation_spline(knots, r, inner).transpose(1, 2) @ rotation_spline(knots, r, inner + h)) / h
    assert torch.allclose(before, after, atol=1e-3)


@pytest.mark.parametrize("degrees", [179.0, 179.99999, 180.0, 180.00001, 181.0])
@pytest.mark.parametrize("count", [2, 3, 4])
def test_turns_of_about_180_degrees_do_not_flip(degrees: float, count: int) -> None:
    r = torch.stack([turn((0.1, 1.0, 0.2), i * degrees) for i in range(count)])
    t = torch.linspace(0, count - 1, 200 * (count - 1) + 1, dtype=F64)
    curve = rotation_spline(torch.arange(count, dtype=F64), r, t)
    step = rotation_angle(curve[:-1], curve[1:])
    # Even steps of about 180 / 200 degrees; a flip would be a step near 180.
    assert torch.rad2deg(step).max() < 2.0
    assert rotation_angle(curve[-1], r[-1]) < 1e-6


@given(seeds, st.integers(2, 5))
def test_the_rotation_spline_moves_with_the_world(seed: int, count: int) -> None:
    r = rotations(seed, count)
    world = rotations(seed + 1, 1)[0]
    knots = torch.arange(count, dtype=F64)
    t = torch.linspace(0, count - 1, 31, dtype=F64)
    assert torch.allclose(world @ rotation_spline(knots, r, t), rotation_spline(knots, world @ r, t), atol=1e-9)


def test_bad_knots_are_refused_in_words() -> None:
    x = torch.zeros(2, 3, dtype=F64)
    with pytest.raises(ValueError, match="strictly increasing"):
        vector_spline(torch.tensor([0.0, 0.0], dtype=F64), x, torch.zeros(1, dtype=F64))
    with pytest.raises(ValueError, match="at least two knots"):
        vector_spline(torch.zeros(1, dtype=F64), x[:1], torch.zeros(1, dtype=F64))


@given(st.permutations(list(range(8))))
def test_the_shortest_order_undoes_a_shuffle_of_a_line(order: list[int]) -> None:
    x = torch.tensor([0.0, 1, 2.5, 3, 4.2, 5, 6.4, 7], dtype=F64)[order]
    found = x[shortest_order((x[:, None] - x[None]).abs())]
    assert bool((found.diff() > 0).all()) or bool((found.diff() < 0).all())


def test_even_parameters_space_an_uneven_curve_evenly() -> None:
    t = torch.linspace(0, 1, 4001, dtype=F64)
    lengths = (t**3).diff()
    found = even_parameters(lengths, t, 11) ** 3
    assert torch.allclose(found, torch.linspace(0, 1, 11, dtype=F64), atol=1e-6)
    closed = even_parameters(lengths, t, 10, closed=True) ** 3
    assert torch.allclose(closed, torch.arange(10, dtype=F64) / 10, atol=1e-6)
    assert len(even_parameters(torch.zeros(4000, dtype=F64), t, 5)) == 5
