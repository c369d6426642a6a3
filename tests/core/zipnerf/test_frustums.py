"""Cone samples against the moments of the conical frustum."""

import math

import pytest
import torch

from cat3d_core.cpu_library import library
from cat3d_core.rays import Rays, perpendicular_basis
from cat3d_core.zipnerf import frustums
from cat3d_core.zipnerf.frustums import (
    cone_samples,
    grid_samples,
    grid_samples_reference,
    sample_distances,
)


@pytest.mark.parametrize("count", [3, 6])
@pytest.mark.parametrize(("t0", "t1"), [(0.0, 1.0), (0.5, 0.6), (1.0, 1.0), (3.0, 100.0), (1e5, 1e6)])
def test_moments_along_the_ray(count: int, t0: float, t1: float) -> None:
    """Mean and variance of t for a cone of radius ~ t, mip-NeRF eq. 7: density proportional to t^2 on [t0, t1]."""
    distances = sample_distances(torch.tensor([[t0, t1]], dtype=torch.float64), count)[0, 0]
    if t1 == t0:
        assert torch.equal(distances, torch.full((count,), t0, dtype=torch.float64))
        return
    moment = [(t1 ** (3 + k) - t0 ** (3 + k)) / (3 + k) for k in range(3)]
    mean = moment[1] / moment[0]
    assert distances.mean().item() == pytest.approx(mean, rel=1e-9)
    assert distances.min() >= t0
    assert distances.max() <= 1.04 * t1  # matching the moments of a cone from its apex reaches 3.3% beyond its base
    variance = moment[2] / moment[0] - mean**2
    # Zip-NeRF's spacing reproduces the variance exactly (checked here, not assumed).
    assert distances.var(unbiased=False).item() == pytest.approx(variance, rel=1e-6)


def test_moments_across_the_ray() -> None:
    """Six samples reproduce the isotropic second moment of the frustum's cross-section: r^2 E[t^2] / 4 each way, their
    share."""
    t = torch.tensor([[1.0, 1.2]], dtype=torch.float64)
    radius = 0.01
    direction = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64)
    means, std = cone_samples(
        torch.zeros_like(direction), direction, torch.full((1, 1), radius, dtype=torch.float64), t
    )
    x, y, z = means[0, 0].unbind(-1)
    assert x.mean().abs() < radius * 0.02
    assert y.mean().abs() < radius * 0.02
    expected = radius**2 * z.square().mean() / 4
    assert x.square().mean().item() == pytest.approx(expected.item(), rel=0.05)
    assert y.square().mean().item() == pytest.approx(expected.item(), rel=0.05)
    torch.testing.assert_close(std[0, 0], 0.5 * radius * z / math.sqrt(2), rtol=1e-9, atol=0)


def test_basis_is_orthonormal_for_every_direction() -> None:
    generator = torch.Generator().manual_seed(0)
    d = torch.randn((2000, 3), generator=generator)
    special = torch.tensor(
        [[0, 0, 1.0], [0, 0, -1], [1, 0, 0], [0, -1, 0], [1e-20, 0, -1], [0, 1e-9, 1], [3e-5, -2e-5, -7]]
    )
    d = torch.cat([d, special])
    frame = torch.cat([perpendicular_basis(d), torch.nn.functional.normalize(d, dim=-1)[:, None]], 1)
    torch.testing.assert_close(frame @ frame.transpose(1, 2), torch.eye(3).expand(len(d), 3, 3), rtol=0, atol=2e-6)


def test_finite_at_the_camera_and_far_away_and_deterministic_without_generator() -> None:
    t = torch.tensor([[0.0, 0.0, 1e-30, 1e-8, 1.0, 1e6, 1e6]])
    ray = (torch.zeros(1, 3), torch.tensor([[0.1, 0.2, 1.0]]), torch.full((1, 1), 1e-3))
    means, std = cone_samples(*ray, t)
    again, _ = cone_samples(*ray, t)
    assert torch.isfinite(means).all()
    assert torch.isfinite(std).all()
    assert (std >= 0).all()
    assert torch.equal(means, again)
    jittered, _ = cone_samples(*ray, t, 6, torch.Generator().manual_seed(1))
    assert torch.isfinite(jittered).all()


def test_other_counts_are_refused() -> None:
    with pytest.raises(ValueError, match="6 or 3"):
        cone_samples(torch.zeros(1, 3), torch.ones(1, 3), torch.ones(1, 1), torch.tensor([[0.0, 1.0]]), 4)


@pytest.mark.skipif(library("zipnerf/cone_samples") is None, reason="There is no C++ compiler here.")
@pytest.mark.parametrize("count", [3, 6])
@pytest.mark.parametrize("intervals", [1, 16, 37])
@pytest.mark.parametrize("seed", [None, 0])
def test_cpu_kernel_matches_float64(count: int, intervals: int, seed: int | None) -> None:
    draw = torch.Generator().manual_seed(7)
    origins = torch.randn((50, 3), generator=draw)
    directions = torch.randn((50, 3), generator=draw) + torch.tensor([0.0, 0.0, 1.0])
    radii = 10 ** (torch.rand((50, 1), generator=draw) * 3 - 4)
    # From the camera to 1e6, as the power ladder has it.
    t = torch.cat([torch.zeros(50, 1), 10 ** (torch.rand((50, intervals), generator=draw) * 8 - 2)], 1).sort(1).values
    t[0] = 0.0  # an interval without width at the camera
    rays = Rays(origins, directions, radii)
    found = []
    for dtype in (torch.float32, torch.float64):
        generator = None if seed is None else torch.Generator().manual_seed(seed)
        flip, turn = frustums._spirals(t, generator)
        with pytest.MonkeyPatch.context() as patch:  # the same random numbers at both precisions
            patch.setattr(frustums, "_spirals", lambda *_, f=flip, u=turn, d=dtype: (f.to(d), u.to(d)))
            found.append(frustums.grid_samples(Rays(*(x.to(dtype) for x in rays)), t.to(dtype), count))
    (positions, std), (exact, exact_std) = found
    assert positions.dtype == torch.float32
    torch.testing.assert_close(positions.double(), exact, rtol=0, atol=1e-6)
    torch.testing.assert_close(std.double(), exact_std, rtol=2e-5, atol=1e-12)


@pytest.mark.skipif(library("zipnerf/cone_samples") is None, reason="There is no C++ compiler here.")
def test_cpu_kernel_draws_as_the_reference_and_passes_nan_on() -> None:
    rays = Rays(torch.zeros(4, 3), torch.eye(3)[[0, 1, 2, 2]], torch.full((4, 1), 0.01))
    t = torch.linspace(0.1, 3, 20).expand(4, 20).contiguous()
    runs = [f(rays, t, 6, torch.Generator().manual_seed(1)) for f in (grid_samples, grid_samples_reference)]
    for got, expected in zip(*runs, strict=True):
        torch.testing.assert_close(got, expected, rtol=1e-4, atol=1e-6)
    broken = grid_samples(rays._replace(origins=torch.full((4, 3), torch.nan)), t)
    assert all(part.isnan().all() for part in broken)
    with pytest.raises(ValueError, match="6 or 3 samples"):
        grid_samples(rays, t, 5)
