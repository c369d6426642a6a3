"""Cameras that do not fit their pixels are found, and sound ones are not accused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from flows.bench.cameras import DAMAGES, rows
from flows.media.lens import distort
from flows.readers import read_capture
from flows.sfm.consistency import _distances, _split, check_consistency, evidence, judge, measure_consistency
from flows.sfm.matches import undistorted

SCENE = "procedural:dtu/3?views=12&width=320&height=240"
GROSS = ("poses are in random order", "all poses are inverse", "camera axes are OpenGL's",
         "all photos are turned by 180 degrees", "a quarter of the photos is turned by 180 degrees",
         "intrinsics are of images twice to eight times as large",
         "one camera is turned by 2 to 20 degrees")  # fmt: skip


@pytest.fixture(scope="module")
def scene():
    capture = read_capture(SCENE)
    return capture, evidence(capture)


def test_exact_cameras_are_not_accused(scene):
    capture, known = scene
    found = judge(capture.cameras.world_from_camera.numpy(), known)
    assert len(found.pairs) >= 12
    assert found.bad_pairs == []
    assert found.bad_triples == []
    assert found.warnings(capture.names) == []


@pytest.mark.parametrize("name", GROSS)
def test_damage_is_caught(scene, name):
    capture, known = scene
    poses, changed, wrong = DAMAGES[name](
        np.random.default_rng(1), capture.cameras.world_from_camera.numpy().copy(), known
    )
    found = judge(poses, changed)
    assert found.warnings(capture.names)
    if len(wrong) == 1:
        assert found.blamed == list(wrong)
        assert capture.names[found.blamed[0]] in found.warnings(capture.names)[0]


def test_a_longer_way_to_one_view_is_told_by_the_third(scene):
    """Along its own epipole a camera can move without leaving any epipolar line of the pair."""
    capture, known = scene
    poses = capture.cameras.world_from_camera.numpy().copy()
    poses[6:, :3, 3] *= 1.6
    assert judge(poses, known).warnings(capture.names)


def test_photos_without_features_say_nothing():
    """A black photo among others, and photos that are black all."""
    capture = read_capture("procedural:dtu/3?views=6&width=96&height=64")
    some, every = list(capture.images), [np.zeros_like(image) for image in capture.images]
    some[2] = every[2]
    assert measure_consistency(replace(capture, images=some)).blamed == []
    assert check_consistency(replace(capture, images=every)) == []


def test_without_cameras_nothing_is_said(scene):
    capture, _ = scene
    assert check_consistency(replace(capture, cameras=None)) == []


def test_distances_are_zero_for_true_matches_and_points_behind_are_seen():
    random = np.random.default_rng(0)
    points = random.uniform(-1, 1, (50, 3)) + [0, 0, 5]
    b_from_a = np.eye(4)[:3].copy()
    b_from_a[:, 3] = [-1.0, 0.2, 0.1]
    there = points @ b_from_a[:, :3].T + b_from_a[:, 3]
    distance, front = _distances(b_from_a, points[:, :2] / points[:, 2:], there[:, :2] / there[:, 2:])
    np.testing.assert_allclose(distance, 0, atol=1e-12)
    assert front.all()
    back = b_from_a.copy()
    back[:, 3] *= -1
    distance, front = _distances(back, points[:, :2] / points[:, 2:], there[:, :2] / there[:, 2:])
    np.testing.assert_allclose(distance, 0, atol=1e-12)
    assert not front.any()


def test_a_break_in_a_sequence_is_named_once():
    bad = [(a, b) for a in range(4) for b in range(8, 11)]
    assert 4 <= _split(bad) <= 8
    assert _split([(0, 5), (1, 5), (2, 5), (3, 5), (5, 7), (5, 8)]) is None


@pytest.mark.parametrize(
    ("coefficients", "fisheye"),
    [([0.2, -0.05, 0.001, 0.002, 0.01], False), ([0.1, 0.02, 0, 0, 0, 0.05, 0.01, 0], False),
     ([0.05, -0.01, 0.003, -0.001], True)],
)  # fmt: skip
def test_undistortion_of_points_inverts_the_lens(coefficients, fisheye):
    rays = torch.rand(200, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) * 1.2 - 0.6
    bent = distort(rays, torch.tensor(coefficients, dtype=torch.float64), fisheye)
    back, solved = undistorted(bent, torch.tensor(coefficients, dtype=torch.float64), fisheye)
    assert solved.all()
    torch.testing.assert_close(back, rays, atol=1e-3, rtol=0)


def test_the_bench_counts_what_it_damaged():
    found = rows([SCENE], trials=15)
    assert found[0]["contradictory"] == 0
    assert found[-1]["trials"] == 15
    assert found[-1]["caught"] >= 12


@pytest.mark.slow
def test_the_cameras_of_the_bedroom_drift(shared_data):
    warnings = check_consistency(read_capture(shared_data / "re10k_bedroom"))
    assert len(warnings) == 1
    assert "do not fit those before it" in warnings[0]
