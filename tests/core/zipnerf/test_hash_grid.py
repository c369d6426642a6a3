"""The grid query: reference against first principles, kernels against the reference in float64, gradients included."""

import math
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from cat3d_core.zipnerf import hash_grid_cpu
from cat3d_core.zipnerf.grid_layout import GridLayout, make_layout
from cat3d_core.zipnerf.grid_reference import level_weights, query_reference

needs_compiler = pytest.mark.skipif(not hash_grid_cpu.available(), reason="There is no C++ compiler here.")


def _inputs(layout: GridLayout, count: int, samples: int = 6) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    table = torch.randn((layout.rows, layout.features), generator=generator)
    centres = torch.rand((count, 1, 3), generator=generator) * 1.04 - 0.02  # also outside the cube
    lengths = 10 ** (torch.rand((count, 1, 1), generator=generator) * -5)  # samples in many cells, in few and in one
    positions = centres + (torch.rand((count, samples, 3), generator=generator) - 0.5) * lengths
    std = 10 ** (torch.rand((count, samples), generator=generator) * 5 - 5)
    return table, positions, std


def test_layout_of_zipnerf_has_its_published_size() -> None:
    sizes = [make_layout(16, n, 21, f).rows * f for n, f in ((512, 1), (2048, 1), (8192, 4))]
    assert sizes == [6_590_464, 10_784_768, 59_916_288]
    layout = make_layout(16, 512, 21, 1)
    assert [layout.hashed(level) for level in range(6)] == [False] * 4 + [True] * 2
    with pytest.raises(ValueError, match="power of two"):
        make_layout(16, 500, 21, 1)


def test_dense_level_interpolates_cell_centres() -> None:
    layout = make_layout(8, 8, 12, 1)
    centres = (torch.arange(8, dtype=torch.float64) + 0.5) / 8
    z, y, x = torch.meshgrid(centres, centres, centres, indexing="ij")
    table = (x + 2 * y - 3 * z).reshape(-1, 1)  # a linear function is reproduced inside
    points = torch.rand((50, 6, 3), dtype=torch.float64) * 0.8 + 0.1
    features, weights = query_reference(table, points, torch.zeros((50, 6), dtype=torch.float64), layout).split(1, -1)
    expected = (points @ torch.tensor([1.0, 2.0, -3.0], dtype=torch.float64)).mean(1)
    torch.testing.assert_close(features[:, 0, 0], expected, rtol=0, atol=1e-12)
    assert torch.equal(weights, torch.ones_like(weights))
    outside = query_reference(table, points + 5, torch.zeros((50, 6), dtype=torch.float64), layout)
    assert not outside[..., 0].any()


def test_level_weights_are_erf_at_every_magnitude() -> None:
    std = torch.cat([torch.zeros(1), 10 ** torch.linspace(-30, 8, 200)])
    weight = level_weights(std, 1024)
    expected = torch.tensor([math.erf(1 / (math.sqrt(8) * float(s) * 1024)) if s else 1.0 for s in std.double()])
    torch.testing.assert_close(weight, expected, rtol=1e-6, atol=1e-9)
    assert weight[0] == 1
    std.requires_grad_()
    level_weights(std, 1024).sum().backward()
    assert std.grad is not None
    assert torch.isfinite(std.grad).all()


def test_reference_gradient() -> None:
    layout = make_layout(2, 8, 5, 2)
    table, positions, std = _inputs(layout, 5)
    table = table.double().requires_grad_()
    assert torch.autograd.gradcheck(lambda t: query_reference(t, positions.double(), std.double(), layout), (table,))


@needs_compiler
@pytest.mark.parametrize("features", [1, 2, 4, 8])
@pytest.mark.parametrize("samples", [3, 6])
@pytest.mark.parametrize("count", [1, 16, 1003])
def test_cpu_kernel_matches_float64(features: int, samples: int, count: int) -> None:
    layout = make_layout(16, 512, 14, features)
    table, positions, std = _inputs(layout, count, samples)
    table.requires_grad_()
    got = hash_grid_cpu.query(table, positions, std, layout)
    exact_table = table.detach().double().requires_grad_()
    expected = query_reference(exact_table, positions.double(), std.double(), layout)
    # Positions and table are the same numbers; the kernel's erf is good to 3e-7, sums of 48 terms of size 1 to 1e-6.
    torch.testing.assert_close(got.double(), expected, rtol=0, atol=3e-6)
    torch.testing.assert_close(got[..., -1].double(), expected[..., -1], rtol=0, atol=1e-6)
    gradient = torch.randn(got.shape, generator=torch.Generator().manual_seed(1))
    got.backward(gradient)
    expected.backward(gradient.double())
    assert table.grad is not None
    torch.testing.assert_close(table.grad.double(), exact_table.grad, rtol=1e-5, atol=2e-5)


@needs_compiler
def test_cpu_kernel_is_deterministic_over_threads() -> None:
    layout = make_layout(16, 256, 12, 4)
    table, positions, std = _inputs(layout, 5000)
    results = []
    before = torch.get_num_threads()
    for threads in (1, 2, 2):
        torch.set_num_threads(threads)
        leaf = table.clone().requires_grad_()
        features = hash_grid_cpu.query(leaf, positions, std, layout)
        features.square().sum().backward()
        results.append((features.detach(), leaf.grad))
    torch.set_num_threads(before)
    for features, gradient in results[1:]:
        assert torch.equal(features, results[0][0])
        assert gradient is not None
        assert torch.equal(gradient, results[0][1])


@needs_compiler
def test_cpu_kernel_stays_finite_far_outside() -> None:
    layout = make_layout(16, 32, 12, 1)
    table = torch.ones((layout.rows, 1), requires_grad=True)
    positions = torch.tensor([1e30, -1e30, 0.5]).expand(4, 6, 3).contiguous()
    features = hash_grid_cpu.query(table, positions, torch.zeros((4, 6)), layout)[..., :-1]
    assert not features[:, 0].any()  # the dense level is zero outside
    hole = hash_grid_cpu.query(table, torch.full((4, 6, 3), torch.nan), torch.zeros((4, 6)), layout)[..., :-1]
    assert hole[:, 1].isnan().all()  # NaN in, NaN out of the hashed level: nothing repaired, nothing read out of bounds
    hole.sum().backward()


@needs_compiler
def test_cpu_kernel_refuses_what_it_cannot_do() -> None:
    layout = make_layout(16, 64, 12, 3)
    table, positions, std = _inputs(layout, 4)
    with pytest.raises(ValueError, match="1, 2, 4 or 8 features"):
        hash_grid_cpu.query(table, positions, std, layout)
    layout = make_layout(16, 64, 12, 4)
    with pytest.raises(ValueError, match="Expected table"):
        hash_grid_cpu.query(table, positions, std, layout)


def test_without_compiler_the_reference_runs_with_one_warning(tmp_path: Path) -> None:
    code = (
        "import torch, warnings\n"
        "from cat3d_core.zipnerf.grid_layout import make_layout\nfrom cat3d_core.zipnerf.hash_grid import query\n"
        "layout = make_layout(4, 8, 8, 1)\n"
        "with warnings.catch_warnings(record=True) as caught:\n"
        "    warnings.simplefilter('always')\n"
        "    for _ in range(2): query(torch.ones(layout.rows, 1), torch.rand(3, 6, 3), torch.zeros(3, 6), layout)\n"
        "assert len(caught) == 1 and 'reference' in str(caught[0].message), caught\n"
    )
    environment = {**os.environ, "CXX": "no-such-compiler", "CAT3D_CACHE": str(tmp_path)}
    subprocess.run([sys.executable, "-c", code], check=True, env=environment, cwd=Path(__file__).resolve().parents[3])


def test_a_level_is_hashed_where_its_cube_does_not_fit_its_own_rows():
    """11^3 = 1331 cells fit 2^13 rows; 22^3 = 10648 do not, though they fit what stands before and after together."""
    layout = make_layout(11, 22, 13, 2)
    assert layout.offsets == (0, 1331, 1331 + 8192)
    assert [layout.hashed(level) for level in range(2)] == [False, True]
    assert not make_layout(16, 16, 12, 2).hashed(0)  # exactly as many
