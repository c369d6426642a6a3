"""Gaussians as data: what a similarity does to them, spherical harmonics, rotations."""

from __future__ import annotations

import math

import pytest
import torch
from torch.nn.functional import normalize

from cat3d_core.cameras import Cameras
from cat3d_core.normalization import Similarity
from cat3d_core.quaternions import quaternion_product, quaternions_from_rotations, rotation_matrices
from cat3d_core.reconstruction.render import Render
from cat3d_core.splats.from_renders import OPACITY, WIDTH, _discs, from_renders
from cat3d_core.splats.gaussians import (
    SH_0,
    Gaussians,
    basis,
    harmonics_of_colour,
)  # fmt: skip
from cat3d_core.splats.rasterize import rasterize
from tests.core.splats.scenes import camera, gaussians

WIDE = torch.float64


def similarity() -> Similarity:
    rotation = rotation_matrices(torch.tensor([0.3, -0.5, 0.7, 0.2], dtype=WIDE))
    return Similarity(2.5, rotation, torch.tensor([3.0, -1.0, 0.5], dtype=WIDE))


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_a_scene_moved_with_its_camera_looks_the_same(degree: int) -> None:
    """Means, scales, rotations and the directions of the colours follow; only depths are in the new unit."""
    g, c, frame = gaussians(80, degree=degree), camera(), similarity()
    here, there = rasterize(g, c), rasterize(g.mapped(frame), frame.cameras(c))
    torch.testing.assert_close(there.features, here.features, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(there.opacity, here.opacity, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(there.depth, 2.5 * here.depth, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_a_similarity_is_undone_by_its_inverse(degree: int) -> None:
    g = gaussians(20, degree=degree)
    back = g.mapped(similarity()).mapped(similarity().inverse())
    torch.testing.assert_close(back.means, g.means)
    torch.testing.assert_close(back.covariances, g.covariances)
    torch.testing.assert_close(back.harmonics, g.harmonics)


def test_covariances_turn_and_grow_with_the_frame() -> None:
    g, frame = gaussians(20), similarity()
    expected = 2.5**2 * frame.rotation @ g.covariances @ frame.rotation.T
    torch.testing.assert_close(g.mapped(frame).covariances, expected)


def test_the_basis_is_orthonormal_on_the_sphere() -> None:
    """By Gauss-Legendre quadrature over height and even steps round it: exact for these polynomials."""
    heights, weights = (torch.from_numpy(part) for part in __import__("numpy").polynomial.legendre.leggauss(8))
    turns = torch.arange(16, dtype=WIDE) * (2 * math.pi / 16)
    beside = (1 - heights**2).sqrt()[:, None]
    directions = torch.stack([beside * turns.cos(), beside * turns.sin(), heights[:, None].expand(8, 16)], -1)
    values = basis(directions, 2)
    gram = torch.einsum("h,hti,htj->ij", weights, values, values) * (2 * math.pi / 16)
    torch.testing.assert_close(gram, torch.eye(9, dtype=WIDE), rtol=0, atol=1e-12)


def test_colours_are_what_the_harmonics_say() -> None:
    colour = torch.tensor([[0.2, 0.5, 0.9]], dtype=WIDE)
    g = gaussians(1)
    plain = Gaussians(g.means, g.quaternions, g.log_scales, g.logits, harmonics_of_colour(colour, 2))
    for viewpoint in torch.randn((5, 3), dtype=WIDE):
        torch.testing.assert_close(plain.colours(viewpoint), colour)
    assert pytest.approx(0.28209479177387814) == SH_0


def test_quaternions_and_rotations_are_each_others_inverse() -> None:
    """Also at half turns, where the usual formula divides by nothing."""
    q = normalize(torch.randn((500, 4), generator=torch.Generator().manual_seed(0), dtype=WIDE), dim=-1)
    q = torch.cat([q, torch.eye(4, dtype=WIDE), -torch.eye(4, dtype=WIDE)])
    back = quaternions_from_rotations(rotation_matrices(q))
    torch.testing.assert_close((back * q).sum(-1).abs(), torch.ones(len(q), dtype=WIDE), rtol=0, atol=1e-12)
    both = quaternion_product(q[:100], q[100:200])
    torch.testing.assert_close(rotation_matrices(both), rotation_matrices(q[:100]) @ rotation_matrices(q[100:200]))


def test_normals_look_at_the_viewpoint_along_the_shortest_axis() -> None:
    g, viewpoint = gaussians(50), torch.tensor([5.0, 1.0, -2.0], dtype=WIDE)
    normals = g.normals(viewpoint)
    assert bool(((viewpoint - g.means) * normals).sum(-1).ge(0).all())
    spread = (normals[:, None] @ g.covariances @ normals[..., None])[:, 0, 0]
    torch.testing.assert_close(spread, g.scales.amin(1) ** 2)


def test_shapes_that_do_not_fit_are_refused() -> None:
    g = gaussians(4)
    with pytest.raises(ValueError, match=r"quaternions has shape \(3, 4\)"):
        Gaussians(g.means, g.quaternions[:3], g.log_scales, g.logits, g.harmonics)
    with pytest.raises(ValueError, match="harmonics has shape"):
        Gaussians(g.means, g.quaternions, g.log_scales, g.logits, g.harmonics.expand(-1, 5, -1))
    with pytest.raises(ValueError, match="logits missing"):
        Gaussians.from_tensors({n: v for n, v in g.tensors().items() if n != "logits"})


@pytest.mark.parametrize("cosine", [1.0, 0.8])
def test_discs_of_a_render_have_the_area_of_their_pixels(cosine: float) -> None:
    """A pixel's image of a surface is longer by 1 / cosine one way; a round disc of the same area by its root."""
    height, width = 4, 4
    k = torch.tensor([[[400.0, 0, 2.0], [0, 400.0, 2.0], [0, 0, 1.0]]])  # all rays within half a degree of the axis
    cameras = Cameras(k, torch.eye(4)[None], torch.tensor([[width, height]]))
    depth, one = torch.full((height, width), 3.0), torch.ones(height, width)
    normal = torch.tensor([(1 - cosine**2) ** 0.5, 0.0, -cosine]).expand(height, width, 3)
    image = torch.full((height, width, 3), 0.25)
    means, normals, colours, opacities, widths = _discs(Render(image, depth, depth, one, normal), cameras, 0)
    torch.testing.assert_close(widths, torch.full((16,), WIDTH / 400 * 3 / cosine**0.5), rtol=0.01, atol=0)
    torch.testing.assert_close(means[:, 2], torch.full((16,), 3.0))
    torch.testing.assert_close(normals, normal.reshape(-1, 3))
    torch.testing.assert_close(opacities, torch.full((16,), OPACITY))
    torch.testing.assert_close(colours, torch.full((16, 3), 0.25))


@pytest.mark.parametrize("most", [1, 5, 100])
def test_splats_of_a_render_are_at_most_as_many_as_asked_for(most: int) -> None:
    k = torch.tensor([[[8.0, 0, 4.0], [0, 8.0, 4.0], [0, 0, 1.0]]])
    cameras = Cameras(k, torch.eye(4)[None], torch.tensor([[8, 8]]))
    depth = torch.linspace(1, 3, 64).view(8, 8)
    normal = torch.tensor([0.0, 0.0, -1.0]).expand(8, 8, 3)
    made = from_renders([Render(torch.rand(8, 8, 3), depth, depth, torch.ones(8, 8), normal)], cameras, most)
    assert 1 <= len(made) <= most
    assert len(made) > 32 or most < 64  # a few pixels share a cell
    assert bool(torch.isfinite(made.log_scales).all())
