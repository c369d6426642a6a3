"""The automatic choice on layouts of each family, moved and thinned, and its sentences."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given

from cat3d_core.trajectories import choose_recipe, scene_frame
from tests.core.plan.layouts import FAMILIES, cameras, single
from tests.core.strategies import random_similarity, seeds

F64 = torch.float64


@pytest.mark.parametrize("name", sorted(FAMILIES))
@given(seed=seeds)
def test_each_family_is_recognised_wherever_its_world_is(name: str, seed: int) -> None:
    captured = random_similarity(seed).cameras(FAMILIES[name]())
    chosen, reasons = choose_recipe(captured, scene_frame(captured))
    assert chosen == name
    assert reasons[0].endswith(".")
    assert f"{len(captured)} captured views" in reasons[0]


def test_views_that_look_apart_are_a_walk() -> None:
    angle = torch.arange(6, dtype=F64)
    out = torch.stack([angle.cos(), angle.sin(), 0 * angle], -1)
    captured = cameras(0.3 * out, 2 * out)
    chosen, reasons = choose_recipe(captured, scene_frame(captured))
    assert chosen == "realestate10k"
    assert "share no point in front" in reasons[0]


def test_a_turn_on_one_spot_needs_parallax() -> None:
    angle = torch.arange(6, dtype=F64)
    captured = cameras(torch.zeros(6, 3, dtype=F64), torch.stack([angle.cos(), angle.sin(), 0 * angle], -1))
    chosen, reasons = choose_recipe(captured, scene_frame(captured))
    assert chosen == "realestate10k"
    assert "shows no depth" in reasons[0]


def test_a_single_view_gets_a_spiral_or_an_orbit_by_its_points() -> None:
    captured = single()
    frame = scene_frame(captured)
    chosen, reasons = choose_recipe(captured, frame)
    assert chosen == "single_spiral"
    assert not frame.scale_known
    assert "taken as 1 world unit" in reasons[-1]

    pixels = torch.rand(2000, 2, generator=torch.Generator().manual_seed(0), dtype=F64) * captured.size[0]
    border = ((pixels / captured.size[0] * 2 - 1).abs().amax(-1, keepdim=True) > 0.4).double()
    for far, expected in ((6.0, "single_orbit"), (2.2, "single_spiral")):
        depth = 2.0 + (far - 2.0) * border
        rays = torch.cat([pixels, torch.ones(2000, 1, dtype=F64)], -1) @ torch.linalg.inv(captured.intrinsics[0]).T
        points = (depth * rays) @ captured.rotation[0].T + captured.centers[0]
        frame = scene_frame(captured, points)
        assert choose_recipe(captured, frame, points)[0] == expected
        assert frame.scale_known
        if expected == "single_orbit":
            assert frame.distance == pytest.approx(2.0, rel=1e-6)
