"""Work is counted right, and no benchmark reaches more than its machine can do."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from torch import nn

from cat3d_core.cameras import Cameras
from cat3d_core.splats import reference
from cat3d_core.zipnerf import PRESETS, Field, hash_grid_cpu
from cat3d_core.zipnerf.grid_layout import make_layout
from flows.bench import counts, limits, metrics, reconstruct, sampler, splats, store, synthetic
from flows.bench.limits import Work

MOST = 1.2  # clocks and busy machines are not exact


@pytest.fixture
def known(monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine of 1e9 operations, 1e8 bytes of memory and 1e7 and 2e7 bytes of files written and read a second."""
    monkeypatch.setattr(limits, "peak_flops", lambda *_: 1e9)
    monkeypatch.setattr(limits, "peak_bytes", lambda *_: 1e8)
    monkeypatch.setattr(limits, "file_rates", lambda *_: (1e7, 2e7))


def test_the_nearer_limit_is_the_share(known: None) -> None:
    near = limits.columns(Work(5e8, 1e7), 1.0)
    assert near == {"gflop_per_s": 0.5, "gb_per_s": 0.01, "share_of_limit": 0.5, "bound_by": "arithmetic"}
    assert limits.columns(Work(5e8, 1e7) * 0.5 + Work(0, 9e7), 2.0)["bound_by"] == "memory"
    row = limits.file_columns(1e6, 2e6, 0.4, Path("/nowhere"))
    assert row["share_of_limit"] == pytest.approx(0.5)
    assert row["bound_by"] == "files"


@pytest.mark.parametrize(("size", "taken"), [(1, 2**16), (2**16 + 1, 2**17), (2**20, 2**20), (1e12, 2**28)])
def test_memory_is_measured_at_the_size_of_the_work(size: float, taken: int) -> None:
    assert limits._rounded(size) == taken


def test_this_machine_has_limits(tmp_path: Path) -> None:
    for clock in ("wall", "cpu"):
        assert 1e7 < limits.peak_flops(torch.float32, "cpu", torch.get_num_threads(), clock) < 1e14  # type: ignore[arg-type]
        assert 1e7 < limits.peak_bytes(2**20, "cpu", torch.get_num_threads(), clock) < 1e13  # type: ignore[arg-type]
    assert all(1e6 < rate < 1e12 for rate in limits.file_rates(tmp_path, "wall"))
    assert list(tmp_path.iterdir()) == []


def test_operations_of_torch_are_counted() -> None:
    a, b = torch.ones(3, 4), torch.ones(4, 5)
    assert counts.counted(lambda: a @ b) == 2 * 3 * 4 * 5
    assert counts.counted(lambda: a * a + a) == 2 * 12
    assert counts.counted(lambda: a.sum(0)) == 12
    assert counts.counted(lambda: (a > 0, a.T)) == 0, "no numbers come of it"
    layer = nn.Linear(4, 5, bias=False)
    inputs = a.clone().requires_grad_()
    assert counts.linear(3, layer).flops == counts.counted(lambda: layer(a))
    wanted = counts.counted(lambda: layer(inputs).backward(torch.ones(3, 5)))
    assert counts.linear(3, layer, backward=True).flops == wanted


def test_a_query_of_the_grid_by_hand() -> None:
    layout = make_layout(2, 4, 6, 2)  # 8 and 64 rows of 2 features
    assert layout.rows == 72
    forward, backward = (counts.grid_query(layout, 10, 3, phase) for phase in ("forward", "backward"))
    assert forward.flops == backward.flops == 10 * 3 * 2 * 8 * (3 + 4)
    assert forward.bytes == 10 * 3 * 16 + 10 * 2 * 3 * 4 + (8 + 10) * 2 * 4
    assert backward.bytes == 10 * 3 * 16 + 10 * 2 * 2 * 4 + 72 * 2 * 4


def test_what_a_field_is_asked_is_counted() -> None:
    config = PRESETS["tiny"]
    field = Field(config)
    rays, intervals, samples, width = 5, 7, config.multisamples, config.density_width
    positions, std = torch.rand(rays, intervals, samples, 3), torch.rand(rays, intervals, samples)
    asked, grid = rays * intervals, field.grids[-1]
    with counts.FieldCount(field) as count, torch.no_grad():
        _, hidden = grid(positions, std)
        field.colour(hidden, torch.rand(rays, 3))
    inputs = grid.layout.levels * (grid.layout.features + 1)
    layers = [(inputs, width), (width, 1), (width, config.bottleneck_width)]
    layers += [(config.bottleneck_width, config.view_width), (config.view_width, 3)]
    assert config.view_depth == 1
    query = counts.grid_query(grid.layout, asked, samples).flops
    directions = 2 * rays * (3 + 6 * config.view_degree) * config.view_width  # once a ray
    assert count.flops == query + directions + sum(2 * asked * a * b for a, b in layers)
    assert count.intervals == asked
    with counts.FieldCount(field) as trained:
        grid(positions, std)
    assert trained.flops == 2 * query + sum(6 * asked * a * b for a, b in layers[:2])
    _, held, _ = reconstruct.procedural_views("dtu", 2, 1, 8, 6)
    whole = reconstruct.dataclasses.replace(config, skip_transmittance=0.0)
    with counts.FieldCount(field) as drawn:
        reconstruct.render_image(field, held.cameras, 0, whole)
    assert drawn.intervals == 8 * 6 * sum(config.samples)
    before = trained.flops
    grid(positions, std)
    assert trained.flops == before, "it counts while it is entered"


def test_pixels_that_gaussians_cover() -> None:
    drawn = torch.Generator().manual_seed(0)
    means = torch.rand((40, 3), generator=drawn) - 0.5
    turns, opacities = torch.randn((40, 4), generator=drawn), torch.rand(40, generator=drawn) * 0.5
    scales = 0.05 + 0.05 * torch.rand((40, 3), generator=drawn)
    pose = torch.eye(4)[None].clone()
    pose[0, 2, 3] = -2.0
    k = torch.tensor([[[64.0, 0, 32], [0, 64, 32], [0, 0, 1]]])
    camera = Cameras(k, pose, torch.tensor([[64, 64]]))
    found = reference.composite(means, turns, scales, opacities, torch.rand(40, 3), camera)
    wanted = int((found.alpha >= reference.LEAST_ALPHA).sum())
    estimate = counts.covered(reference.project(means, turns, scales, opacities, camera), 64, 64)
    assert estimate == pytest.approx(wanted, rel=0.05)
    work = counts.rasterization([means, turns, scales, opacities, torch.rand(40, 3)], camera)
    assert work == Work(estimate * counts.PAIR_FLOPS + 40 * counts.PROJECT_FLOPS, 4.0 * (40 * 14 + 64 * 64 * 4))


def test_metrics_by_hand() -> None:
    assert counts.psnr(10) == Work(30, 80)
    assert counts.ssim(10, 11) == Work(10 * (4 * 2 * 21 + 16), 80)


def shares(rows: list[dict]) -> list[float]:
    found = [value for row in rows for name, value in row.items() if name.endswith("share_of_limit")]
    assert len(found) >= len(rows)
    assert all(math.isfinite(value) for value in found)
    return found


def in_bounds(rows: list[dict]) -> bool:
    return all(0 < share <= MOST for share in shares(rows))


def test_shares_of_the_field(monkeypatch: pytest.MonkeyPatch) -> None:
    views, held, depths = reconstruct.procedural_views("dtu", 3, 1, 16, 16)
    short = reconstruct.dataclasses.replace(PRESETS["tiny"], iterations=3, warmup_iterations=1, batch_rays=64)
    row = reconstruct.train_and_measure(short, views, held, depths)
    assert in_bounds([row])
    monkeypatch.setattr(reconstruct, "WORKLOADS", (("fast", 12),))
    rows = reconstruct.kernels(16, repeats=1, threads=(1,))
    assert in_bounds(rows)
    assert hash_grid_cpu.available() == ("C++ kernel" in {row["kernel"] for row in rows})


def test_shares_of_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(splats, "WORKLOADS", ((200, 16),))
    monkeypatch.setattr(store, "FORMATS", {"image": dict([next(iter(store.FORMATS["image"].items()))])})
    monkeypatch.setattr(store, "CODECS", {name: store.CODECS[name] for name in ("raw", "zstd-1 shuffle")})
    monkeypatch.setattr(synthetic, "FAMILIES", ("dtu",))
    images = torch.rand(2, 64, 64, 3).numpy()
    assert in_bounds(splats.kernel_rows(1, (1,)))
    assert in_bounds(store._content_rows("image", images, "noise", 1))
    assert in_bounds(metrics.rows(1, 64, 64, 1))
    assert in_bounds(synthetic.rows(16, 1, 1))


def test_shares_of_the_sampler() -> None:
    problem = sampler.mixture_problem(2)
    model, latents, cameras, noise = problem
    one = sampler.evaluation_work(problem, torch.float32)
    numbers, modes = noise[0].numel(), model.unet.modes  # type: ignore[attr-defined]
    assert one.flops > 2 * numbers * modes + 3 * numbers * modes, "distances to all means, and their mean"
    config = sampler.SamplerConfig(steps=4)
    exact = torch.zeros_like(noise, dtype=torch.float64)
    row = sampler._measure(problem, config, exact, exact)
    assert in_bounds([row | limits.columns(one * row["evaluations"], row["seconds"], dtype=torch.float64)])
