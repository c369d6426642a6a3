"""Projection and rasterisation: closed forms, a brute-force composite, and the C++ kernels against the reference."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from cat3d_core.cameras import Cameras
from cat3d_core.splats import rasterize_cpu, reference
from cat3d_core.splats.gaussians import Gaussians
from cat3d_core.splats.rasterize import FAR, rasterize, render
from cat3d_core.splats.reference import Window
from tests.core.splats.scenes import camera, gaussians

kernels = pytest.mark.skipif(not rasterize_cpu.available(), reason="There is no C++ compiler here.")
TOLERANCE = {torch.float64: 1e-12, torch.float32: 1e-5}
UNDECIDED = 1e-5
"""Pixels that are relatively nearer than this to a cut are compared loosely and give no gradient: rounding decides."""


def straight(width: int = 32, focal: float = 32.0) -> Cameras:
    """A camera at the origin that looks along z."""
    k = torch.tensor([[[focal, 0, width / 2], [0, focal, width / 2], [0, 0, 1]]], dtype=torch.float64)
    return Cameras(k, torch.eye(4, dtype=torch.float64)[None], torch.tensor([[width, width]]))


def one(scale: list[float], depth: float = 4.0, logit: float = 0.0) -> Gaussians:
    """One white Gaussian on the axis."""
    wide = torch.float64
    return Gaussians(
        torch.tensor([[0.0, 0.0, depth]], dtype=wide), torch.tensor([[1.0, 0, 0, 0]], dtype=wide),
        torch.tensor([scale], dtype=wide).log(), torch.tensor([logit], dtype=wide), torch.ones((1, 1, 3), dtype=wide),
    )  # fmt: skip


def inputs(g: Gaussians, dtype: torch.dtype = torch.float64) -> list[Tensor]:
    colours = torch.rand((len(g), 3), generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    return [value.to(dtype) for value in (g.means, g.quaternions, g.scales, g.opacities, colours)]


def test_a_gaussian_on_the_axis_is_drawn_as_the_formula_says() -> None:
    """Standard deviations 0.5 and 0.25 at depth 4 and focal length 32 are 4 and 2 pixels; the blur adds 0.3 to both
    variances and takes the opacity down by the root of the ratio of the determinants."""
    raster = reference.rasterize(
        *inputs(one([0.5, 0.25, 1e-6]))[:4], torch.ones((1, 1), dtype=torch.float64), straight()
    )
    x = torch.arange(32, dtype=torch.float64) + 0.5 - 16
    xx, yy = 16.3, 4.3
    peak = 0.5 * math.sqrt(16 * 4 / (xx * yy))
    alpha = peak * torch.exp(-0.5 * (x[None, :] ** 2 / xx + x[:, None] ** 2 / yy))
    alpha = torch.where(alpha >= 1 / 255, alpha, 0.0)
    torch.testing.assert_close(raster.opacity, alpha, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(raster.features[0], alpha, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(raster.depth, 4 * alpha, rtol=1e-12, atol=1e-12)


def test_antialiasing_keeps_what_a_small_gaussian_covers() -> None:
    """The sum over the pixels is opacity times area at every distance; without antialiasing it grows far away."""
    sums: dict[bool, list[float]] = {True: [], False: []}
    for antialias, found in sums.items():
        for depth in (2.0, 4.0, 8.0):
            g = one([0.05, 0.05, 0.05], depth, 4.0)
            raster = reference.rasterize(
                *inputs(g)[:4], torch.ones((1, 1), dtype=torch.float64), straight(), None, antialias
            )
            found.append(float(raster.opacity.sum()) * depth**2)
    assert max(sums[True]) / min(sums[True]) < 1.15  # the cut at 1/255 takes a tenth of the faintest
    assert max(sums[False]) / min(sums[False]) > 3


def test_an_opaque_gaussian_hides_what_is_behind_it() -> None:
    front, back = one([2.0, 2.0, 0.01], 3.0, 12.0), one([2.0, 2.0, 0.01], 5.0, 12.0)
    both = Gaussians.cat([back, front])
    means, quaternions, scales, opacities, _ = inputs(both)
    colours = torch.tensor([[1.0, 0, 0], [0, 1.0, 0]], dtype=torch.float64)
    for draw in (reference.rasterize, rasterize_cpu.rasterize) if rasterize_cpu.available() else (reference.rasterize,):
        raster = draw(means, quaternions, scales, opacities, colours, straight())
        assert raster.features[:, 16, 16].tolist() == pytest.approx([0.001 * 0.999, 0.999, 0], abs=1e-3)
        assert float(raster.median[16, 16]) == 3.0


def test_the_reference_is_the_plain_loop_over_gaussians() -> None:
    """Front to back, one Gaussian and one pixel at a time, from the projections alone."""
    g, c = gaussians(30), camera(12, 9)
    means, quaternions, scales, opacities, colours = inputs(g)
    flat = reference.project(means, quaternions, scales, opacities, c)
    raster = reference.rasterize(means, quaternions, scales, opacities, colours, c)
    for row in range(9):
        for column in range(12):
            light, total = 1.0, torch.zeros(3, dtype=torch.float64)
            for i in flat.depth.argsort().tolist():
                if flat.depth[i] <= reference.NEAR:
                    continue
                d = torch.tensor([column + 0.5, row + 0.5], dtype=torch.float64) - flat.centre[i]
                a, b, e = flat.conic[i]
                alpha = float(flat.opacity[i] * torch.exp(-0.5 * (a * d[0] ** 2 + e * d[1] ** 2) - b * d[0] * d[1]))
                if alpha < 1 / 255:
                    continue
                alpha = min(alpha, 0.999)
                if light * (1 - alpha) < 1e-4:
                    break
                total += light * alpha * colours[i]
                light *= 1 - alpha
            torch.testing.assert_close(raster.features[:, row, column], total, rtol=1e-10, atol=1e-12)
            assert float(raster.opacity[row, column]) == pytest.approx(1 - light, abs=1e-12)


def test_the_projection_is_that_of_many_points() -> None:
    """Mean and covariance of projected samples of a small Gaussian are those of its image."""
    g, c = gaussians(1, seed=3), camera()
    g = Gaussians(
        g.means * 0.1, g.quaternions, g.log_scales * 0 - 4.0 + torch.tensor([0.0, 0.5, -0.5]), g.logits, g.harmonics
    )
    flat = reference.project(*inputs(g)[:4], c)
    draw = torch.randn((200_000, 3), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    points = g.means + (g.rotations[0] @ (g.scales * draw).T).T
    pixels, _ = c.project(points)
    covariance = torch.cov(pixels[0].T)
    torch.testing.assert_close(pixels[0].mean(0), flat.centre[0], rtol=0, atol=0.01)
    a, b, e = flat.conic[0]
    image = torch.linalg.inv(torch.stack([torch.stack([a, b]), torch.stack([b, e])])) - reference.BLUR * torch.eye(2)
    torch.testing.assert_close(covariance, image, rtol=0.02, atol=0.005)


@pytest.mark.parametrize("count", [1, 40, 300])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("antialias", [True, False])
@kernels
def test_the_kernels_agree_with_the_reference(count: int, dtype: torch.dtype, antialias: bool) -> None:
    """Values and gradients with respect to everything, also in a window of the image."""
    c, window = camera(), Window(5, 3, 29, 31)
    exact = [value.requires_grad_() for value in inputs(gaussians(count, seed=count))]
    found = reference.composite(*exact, c, window, antialias)
    wanted, decided = found.raster, reference.margin(found) > UNDECIDED
    assert decided.double().mean() > 0.95
    generator = torch.Generator().manual_seed(2)
    weights = [torch.randn(part.shape, generator=generator, dtype=torch.float64) * decided for part in wanted[:3]]
    sum((part * weight).sum() for part, weight in zip(wanted, weights, strict=False)).backward()
    given = [value.detach().to(dtype).requires_grad_() for value in exact]
    got = rasterize_cpu.rasterize(*given, c.to(dtype=dtype), window, antialias)
    sum((part * weight.to(dtype)).sum() for part, weight in zip(got, weights, strict=False)).backward()
    for a, b in zip(got, wanted, strict=True):
        close = torch.isclose(a.double(), b, rtol=TOLERANCE[dtype], atol=TOLERANCE[dtype])
        assert bool((close | ~decided).all())
    for a, b in zip(given, exact, strict=True):
        assert a.grad is not None
        assert b.grad is not None
        scale = float(b.grad.abs().max()) + 1e-30
        assert float((a.grad - b.grad).abs().max()) < 3 * TOLERANCE[dtype] * scale


@kernels
def test_the_reference_differentiates_rightly() -> None:
    """Autograd of the reference against finite differences, so that the kernels' gradients stand on firm ground."""
    c = camera(9, 7)
    values = [v.requires_grad_() for v in inputs(gaussians(5, seed=5))]

    def total(*given: Tensor) -> Tensor:
        raster = rasterize_cpu.rasterize(*given, c)
        return (raster.features.sum(0) + raster.depth + 2 * raster.opacity).sum()

    assert torch.autograd.gradcheck(total, values, eps=1e-7, atol=1e-5, rtol=1e-4)


@kernels
def test_the_kernels_give_the_same_bits_with_any_number_of_threads() -> None:
    found, before = [], torch.get_num_threads()
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            given = [v.requires_grad_() for v in inputs(gaussians(400), torch.float32)]
            raster = rasterize_cpu.rasterize(*given, camera().to(dtype=torch.float32))
            (raster.features.square().sum() + raster.depth.sum()).backward()
            found.append([*raster, *(v.grad for v in given)])
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(a, b) for other in found[1:] for a, b in zip(found[0], other, strict=True))


def test_a_window_and_a_cropped_camera_see_a_part_of_the_image() -> None:
    g, c = gaussians(60), camera()
    whole = rasterize(g, c)
    for part in (rasterize(g, c, Window(7, 11, 20, 13)), rasterize(g, c.crop(7, 11, 20, 13))):
        torch.testing.assert_close(whole.features[:, 11:24, 7:27], part.features, rtol=1e-9, atol=1e-9)


def test_nothing_to_see_is_nothing() -> None:
    behind = one([0.1, 0.1, 0.1], -1.0)
    for g in (behind, behind[:0]):
        raster = rasterize(g, straight())
        assert not raster.opacity.any()
        assert not raster.features.any()
        seen = render(g, straight(), 0)
        assert bool((seen.image == 0.5).all())
        assert bool((seen.depth == FAR).all())
        assert bool((seen.depth_mean == FAR).all())


def test_a_render_knows_depth_and_normals() -> None:
    """A sheet across the axis, facing the camera."""
    seen = render(one([3.0, 3.0, 0.01], 4.0, 9.0), straight(), 0, scale=0.5)
    assert seen.image.shape == (16, 16, 3)
    assert float(seen.depth[8, 8]) == pytest.approx(4.0)
    assert float(seen.depth_mean[8, 8]) == pytest.approx(4.0)
    assert seen.normals[8, 8].tolist() == pytest.approx([0, 0, -1])


@kernels
def test_what_does_not_fit_is_refused() -> None:
    means, quaternions, scales, opacities, colours = inputs(gaussians(3))
    with pytest.raises(ValueError, match="Expected means"):
        rasterize_cpu.rasterize(means, quaternions[:2], scales, opacities, colours, camera())
    with pytest.raises(ValueError, match="one dtype"):
        rasterize_cpu.rasterize(means, quaternions.float(), scales, opacities, colours, camera())
    with pytest.raises(ValueError, match="features, not 2"):
        rasterize_cpu.rasterize(means, quaternions, scales, opacities, colours[:, :2], camera())
    with pytest.raises(ValueError, match="is empty"):
        rasterize_cpu.rasterize(means, quaternions, scales, opacities, colours, camera(), Window(0, 0, 0, 4))
