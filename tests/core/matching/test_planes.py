"""Planes and distributions over them, against closed forms."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from cat3d_core.matching.planes import inverse_depth_of, local_mean, position_of, quantiles, soft_assignment


@given(st.floats(0, 1), st.floats(1, 100))
def test_position_undoes_inverse_depth(t: float, nearest: float) -> None:
    there = inverse_depth_of(torch.tensor(t, dtype=torch.float64), nearest)
    assert float(position_of(there, nearest)) == pytest.approx(t, abs=1e-12)


def test_planes_reach_from_infinity_to_the_nearest() -> None:
    planes = inverse_depth_of(torch.linspace(0, 1, 32, dtype=torch.float64), 10.0)
    assert float(planes[0]) == 0
    assert float(planes[-1]) == pytest.approx(10)
    assert (planes.diff() > 0).all()


def test_soft_assignment_keeps_the_mean() -> None:
    position = torch.rand(2, 3, 4, dtype=torch.float64)
    weight = soft_assignment(position, 9)
    assert int((weight > 0).sum(1).max()) <= 2
    torch.testing.assert_close(weight.sum(1), torch.ones_like(position))
    mean = (weight * torch.linspace(0, 1, 9, dtype=torch.float64).view(1, 9, 1, 1)).sum(1)
    torch.testing.assert_close(mean, position)


def test_local_mean_does_not_mix_two_surfaces() -> None:
    probability = torch.zeros(1, 32, 1, 1)
    probability[0, [4, 5, 25]] = torch.tensor([0.3, 0.3, 0.4]).view(3, 1, 1)
    assert float(local_mean(probability)) == pytest.approx(25 / 31)


def test_quantiles_of_an_even_distribution_are_even() -> None:
    place, density = quantiles(torch.full((1, 32, 2, 2), 1 / 32), 8)
    expected = (((torch.arange(8) + 0.5) / 8 * 32 - 0.5) / 31).clamp(0, 1).view(1, 8, 1, 1).expand(1, 8, 2, 2)
    torch.testing.assert_close(place, expected, rtol=0, atol=1e-5)
    torch.testing.assert_close(density, torch.full_like(density, 1 / 32))


def test_quantiles_gather_at_a_certain_plane_and_leave_some_elsewhere() -> None:
    probability = torch.zeros(1, 32, 1, 1)
    probability[0, 20] = 1
    place, _ = quantiles(probability, 8)
    assert (place.diff(dim=1) >= 0).all()
    assert int(((place - 20 / 31).abs() < 0.5 / 31 + 1e-6).sum()) >= 7
    assert float(quantiles(probability, 40)[0].min()) < 0.4  # the floor's share
