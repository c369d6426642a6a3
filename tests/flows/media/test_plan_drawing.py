"""Plans of real scenes (automatic choice, no camera in, under or turned from the scene), their pictures and tables."""

from __future__ import annotations

import io
from pathlib import Path

import pytest
import torch
from PIL import Image
from rich.console import Console

from cat3d_core.plan import PlanConfig, make_plan
from cat3d_core.trajectories import FreeSpace
from flows.media.plan_drawing import draw_plan, plan_table
from flows.readers import read_capture
from tests.core.plan.layouts import ring, single

# What a person would choose for each capture, looking at it.
REAL = {
    "llff_fern": "llff",
    "llff_flower": "llff",
    "dtu_scan24": "dtu",
    "dtu_scan37": "dtu",
    "co3d_apple": "mipnerf360",  # 290 of 360 degrees round the apple
    "re10k_bedroom": "realestate10k",
    "mipnerf360_bonsai": "mipnerf360",
    "fox": "dtu",
    "strecha_fountain_P11": "co3d",  # a level arc of 107 degrees
    "nerf_synthetic_lego": "mipnerf360",
}


@pytest.mark.parametrize("scene", sorted(REAL))
def test_real_scene_gets_the_right_plan(shared_data: Path, scene: str) -> None:
    capture = read_capture(shared_data / scene)
    assert capture.cameras is not None
    plan = make_plan(capture.cameras, PlanConfig(image_size=64), capture.points, capture.depth_bounds)
    assert plan.recipe == REAL[scene]
    views, frame = plan.cameras, plan.frame
    assert ((views.up @ frame.up) > 0).all(), "a camera is upside down"
    pixels, depth = views.project(frame.center[None])
    assert (depth > 0).all(), "a camera faces away"
    assert ((pixels >= 0) & (pixels <= 64)).all()
    free = FreeSpace.of(capture.cameras.to(dtype=torch.float64), frame, capture.points)
    assert not free.blocked(views.centers).any(), "a camera is inside the geometry"
    # As far out as the captured cameras, give or take: none inside the object, none lost in the distance.
    radius = (views.centers - frame.center).norm(dim=-1)
    captured = (capture.cameras.centers.double() - frame.center).norm(dim=-1)
    assert radius.min() > 0.5 * captured.min()
    assert radius.max() < 1.6 * captured.max()


def test_picture_shows_captured_anchor_and_planned_views() -> None:
    captured = single()
    plan = make_plan(captured, PlanConfig("single_orbit", image_size=64))
    png = draw_plan(captured, plan, points=torch.randn(50, 3, dtype=torch.float64), title="a scene")
    picture = Image.open(io.BytesIO(png)).convert("RGB")
    assert picture.width > 900
    colours = {c for _, c in picture.getcolors(maxcolors=1 << 20)}
    assert (0xD6, 0x27, 0x28) in colours  # captured, red
    assert (0xFF, 0x7F, 0x0E) in colours  # anchors, orange


def test_table_names_groups_conditions_and_reasons() -> None:
    plan = make_plan(ring(4), PlanConfig(count=23, image_size=64))
    console = Console(width=160, record=True, file=io.StringIO())
    console.print(plan_table(plan, names=["a.jpg", "b.jpg", "c.jpg", "d.jpg"]))
    text = console.export_text()
    assert "mipnerf360: 23 views in 5 groups" in text
    assert "20-22" in text
    assert "a.jpg" in text
    assert "Voxels seen" in text
    assert "ellipses all round the scene" in " ".join(text.split())


def test_long_tables_are_shortened() -> None:
    plan = make_plan(single(), PlanConfig("single_orbit", image_size=64))
    table = plan_table(plan, rows=6)
    assert table.row_count == 7  # six groups and the dots between
