"""What a training of splats starts from: their widths, learning rates, settings, and cameras between others."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from cat3d_core.cameras import Cameras
from cat3d_core.normalization import normalize_scene
from cat3d_core.reconstruction.views import Views
from cat3d_core.splats.config import PRESETS
from cat3d_core.splats.rasterize_cpu import available
from cat3d_core.splats.start import start
from cat3d_core.splats.trainer import SplatTrainer
from cat3d_core.splats.viewpoints import between
from cat3d_core.synthetic import random_cameras, random_scene

pytestmark = pytest.mark.skipif(not available(), reason="There is no C++ compiler here.")
SHORT = dataclasses.replace(PRESETS["tiny"], iterations=100, start=1500, most=2000)


@pytest.fixture(scope="module")
def wall() -> Views:
    """Twelve grey pictures, 32 pixels wide, of a wall two units before every camera."""
    cameras = random_cameras(random_scene("co3d", 0), 0, 12, 32, 32)
    cameras = normalize_scene(cameras).cameras(cameras)
    grey = [torch.full((32, 32, 3), 128, dtype=torch.uint8)] * 12
    return Views.from_images(cameras, grey, torch.ones(12, dtype=torch.bool), depths=[torch.full((32, 32), 2.0)] * 12)


def test_learning_rates_fall_logarithmically(wall: Views) -> None:
    trainer = SplatTrainer(dataclasses.replace(SHORT, iterations=40, lr_final=0.25), wall, 0)
    config = trainer.config
    ends = {"means": config.lr_means_final / config.lr_means}
    first = {name: getattr(config, f"lr_{name}") for name in trainer.learning_rates()}
    for done in (0, 10, 40, 50):  # never below the last step's
        trainer.iteration = done
        share = min(1.0, done / 40)
        wanted = {name: rate * ends.get(name, 0.25) ** share for name, rate in first.items()}
        assert trainer.learning_rates() == pytest.approx(wanted)
    still = SplatTrainer(dataclasses.replace(SHORT, lr_means=0.0, lr_means_final=0.0), wall, 0)
    assert still.learning_rates()["means"] == 0.0


@pytest.mark.parametrize(
    "fits", [{"lr_final": 1.0}, {"lr_means_final": 0.0}, {"grow": 1.0}, {"shell": 0.0}, {"most": SHORT.start}]
)
def test_settings_at_the_end_of_their_range_are_taken(fits: dict[str, float]) -> None:
    dataclasses.replace(SHORT, **fits)


def test_the_widest_gap_is_filled_first() -> None:
    """Cameras on a line at 0, 1 and 3: half-way between 0 and 3, then 1 and 3, then 0 and 1."""
    poses = torch.eye(4, dtype=torch.float64).repeat(3, 1, 1)
    poses[:, 0, 3] = torch.tensor([0.0, 1.0, 3.0])
    k = torch.eye(3, dtype=torch.float64).expand(3, 3, 3)
    every = between(Cameras(k, poses, torch.tensor([[8, 8]] * 3)), 6)
    assert every.centers[:, 0].tolist() == pytest.approx([0, 1, 3, 1.5, 2, 0.5])


def test_splats_start_as_wide_as_the_pixels_that_each_stands_for(wall: Views) -> None:
    """Half a pixel's width of the surface, by the root of the pixels for each; twice as wide on the far shell."""
    focal = float(wall.cameras.intrinsics[0, 0, 0])
    assert torch.equal(wall.cameras.intrinsics[:, 0, 0], wall.cameras.intrinsics[:1, 0, 0].expand(12))
    each = 12 * 32 * 32 / 500
    for shell in (0.0, 0.5):
        config = dataclasses.replace(SHORT, start=500, shell=shell, far=20.0, near=0.3)
        made = start(wall, config, torch.Generator().manual_seed(0))
        far = made.scales[:, 0] > 0.5 * 20.0 / focal * each**0.5
        assert 0.8 * shell <= float(far.float().mean()) <= 1.2 * shell
        wanted = torch.where(far, 2 * 0.5 * 20.0, 0.5 * 2.0)[:, None].expand(-1, 3) / focal * each**0.5
        torch.testing.assert_close(made.scales, wanted, rtol=1e-4, atol=0)
        torch.testing.assert_close(made.opacities, torch.full_like(made.opacities, config.start_opacity))


def test_splats_of_unknown_depth_start_between_near_and_far(wall: Views) -> None:
    """Pictures of noise: the depth at which others look most alike is any; a splat's width tells which was taken."""
    g = torch.Generator().manual_seed(0)
    noise = [torch.randint(0, 256, (32, 32, 3), generator=g, dtype=torch.uint8) for _ in range(12)]
    config = dataclasses.replace(SHORT, start=1500, shell=0.0, near=0.5, far=8.0)
    made = start(Views.from_images(wall.cameras, noise, wall.captured), config, g)
    depth = made.scales[:, 0] * float(wall.cameras.intrinsics[0, 0, 0]) / (0.5 * (12 * 32 * 32 / 1500) ** 0.5)
    assert 0.499 < float(depth.min()) < 0.55
    assert 6 < float(depth.max()) < 8.01
