"""The network: 2D when alone, joint over views, blind to order and to other groups, and unmoved by rays at first."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from cat3d_core.cameras import Cameras
from cat3d_core.diffusion import SIZES, MultiViewUNet, count_flops, count_parameters
from cat3d_core.diffusion.attention import Attention, ViewFrames, fold_views, unfold_views
from cat3d_core.diffusion.conditioning import camera_vectors, view_matrices
from cat3d_core.rays import matrix_rays, raymap, reference_from_image
from tests.core.diffusion.models import inputs, random_model, randomized, tiny

VARIANTS = [
    {},
    {"view_attention": "temporal"},
    {"decoder_only": True},
    {"max_3d_size": 4},
    {"camera": "vector"},
    {"linear_projection": False},
]


@given(st.integers(1, 3), st.integers(1, 4), st.integers(1, 5), st.sampled_from(["3d", "temporal", "none"]))
def test_folding_is_undone_and_keeps_groups_apart(groups, views, length, mode):
    tokens = torch.arange(groups * views * length * 2).reshape(groups * views, length, 2)
    folded = fold_views(tokens, views, mode)
    assert torch.equal(unfold_views(folded, views, length, mode), tokens)
    group_of_token = torch.arange(groups).repeat_interleave(views)[:, None, None].expand(-1, length, 1)
    for sequence in fold_views(group_of_token, views, mode):
        assert len(sequence.unique()) == 1


@pytest.mark.parametrize("changes", VARIANTS)
def test_one_view_is_the_2d_network(changes):
    """V = 1: joining views changes nothing (1e-5, float32). Temporal attention has weights of its own: zero at
    first."""
    joint = random_model(**changes).unet
    if joint.config.view_attention == "temporal":
        for name, parameter in joint.named_parameters():
            if "attn_views.to_out" in name:
                parameter.zero_()
    flat = MultiViewUNet(tiny(**{**changes, "view_attention": "none"}).unet).eval()
    flat.load_state_dict(joint.state_dict(), strict=False)
    latents, time, cameras, mask = inputs(6, 1, 0)
    with torch.no_grad():
        expected = flat(latents, time, cameras, mask)
        torch.testing.assert_close(joint(latents, time, cameras, mask), expected, rtol=0, atol=1e-5)
        # And in a 2D network the views of a group are on their own.
        together = flat(latents.reshape(2, 3, 8, 8, 8), time[:2], cameras.reshape(2, 3, 4, 4), mask.reshape(2, 3))
        alone = flat(latents, time[:2].repeat_interleave(3), cameras, mask)
    torch.testing.assert_close(together.flatten(0, 1), alone.flatten(0, 1), rtol=0, atol=1e-5)


@pytest.mark.parametrize("changes", [*VARIANTS, {"relative_cameras": True}])
def test_permuting_views_permutes_outputs(changes):
    unet = random_model(**changes).unet
    latents, time, cameras, mask = inputs(2, 5, 2)
    order = torch.tensor([0, 1, 4, 2, 3])
    with torch.no_grad():
        expected = unet(latents, time, cameras, mask)[:, order]
        got = unet(latents[:, order], time, cameras[:, order], mask[:, order])
    torch.testing.assert_close(got, expected, rtol=0, atol=2e-5)


@pytest.mark.parametrize("changes", [*VARIANTS, {"relative_cameras": True}])
def test_groups_never_mix_and_views_do(changes):
    """The gradient of one group's output reaches no other group, and every view of its own."""
    unet = random_model(**changes).unet
    latents, time, cameras, mask = inputs(3, 4, 1)
    latents.requires_grad_()
    unet(latents, time, cameras, mask)[1, 2].sum().backward()
    reach = latents.grad.abs().amax((2, 3, 4)) > 0
    assert not reach[[0, 2]].any()
    assert reach[1].all()


@pytest.mark.parametrize("changes", [{}, {"decoder_only": True}])
def test_rays_and_mask_have_no_effect_at_initialisation(changes):
    unet = randomized(MultiViewUNet(tiny(**changes).unet), new_channels=False)
    latents, time, cameras, mask = inputs(2, 4, 1)
    with torch.no_grad():
        plain = unet(latents, time, torch.zeros_like(cameras), torch.zeros_like(mask))
        assert plain.abs().mean() > 0.01
        assert torch.equal(unet(latents, time, cameras, mask), plain)


def _cameras(count: int, seed: int) -> Cameras:
    g = torch.Generator().manual_seed(seed)
    rotation = torch.linalg.qr(torch.randn(count, 3, 3, generator=g, dtype=torch.float64))[0]
    rotation = rotation * torch.linalg.det(rotation)[:, None, None]
    pose = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    pose[:, :3, :3] = rotation
    pose[:, :3, 3] = torch.randn(count, 3, generator=g, dtype=torch.float64)
    k = torch.zeros(count, 3, 3, dtype=torch.float64)
    k[:, 0, 0] = 50 + 30 * torch.rand(count, generator=g, dtype=torch.float64)
    k[:, 1, 1] = k[:, 0, 0] * 1.1
    k[:, 0, 2], k[:, 1, 2], k[:, 2, 2] = 30, 33, 1
    return Cameras(k, pose, torch.full((count, 2), 64))


@given(st.integers(0, 10_000))
def test_rigid_motion_of_the_world_changes_nothing(seed):
    cameras = _cameras(4, seed)
    motion = _cameras(1, seed + 1).world_from_camera[0]
    moved = Cameras(cameras.intrinsics, motion @ cameras.world_from_camera, cameras.size)
    before = raymap(cameras, cameras.world_from_camera[0], 8, 8)
    after = raymap(moved, moved.world_from_camera[0], 8, 8)
    torch.testing.assert_close(after, before, rtol=0, atol=1e-12)
    matrices = [reference_from_image(c, c.world_from_camera[0]) for c in (cameras, moved)]
    torch.testing.assert_close(matrices[1], matrices[0], rtol=0, atol=1e-12)
    torch.testing.assert_close(matrix_rays(matrices[1], 8, 8), before, rtol=0, atol=1e-12)


@pytest.mark.parametrize("changes", [{}, {"relative_cameras": True}])
def test_network_output_is_invariant_to_rigid_motion(changes):
    unet = random_model(**changes).unet
    latents, time, _, mask = inputs(1, 4, 1)
    cameras = _cameras(4, 3)
    motion = _cameras(1, 4).world_from_camera[0]
    moved = Cameras(cameras.intrinsics, motion @ cameras.world_from_camera, cameras.size)
    matrices = [reference_from_image(c, c.world_from_camera[0])[None] for c in (cameras, moved)]
    with torch.no_grad():
        first, second = (unet(latents, time, m, mask) for m in matrices)
    torch.testing.assert_close(first, second, rtol=0, atol=1e-5)


@given(st.integers(0, 10_000))
def test_camera_vector_is_position_rotation_and_focal_length(seed):
    """Position, rotation and focal length, exact to 1e-9 in float64; zeros for a dropped pose."""
    cameras = _cameras(3, seed)
    vectors = camera_vectors(reference_from_image(cameras, torch.eye(4, dtype=torch.float64)))
    torch.testing.assert_close(vectors[:, :3], cameras.centers, rtol=0, atol=1e-9)
    torch.testing.assert_close(vectors[:, 7], cameras.intrinsics[:, 0, 0] / 64, rtol=1e-9, atol=0)
    w, x, y, z = vectors[:, 3:7].unbind(-1)
    forward = torch.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], -1)
    torch.testing.assert_close(forward, cameras.forward, rtol=0, atol=1e-9)
    assert torch.equal(camera_vectors(torch.zeros(2, 4, 4)), torch.zeros(2, 8))


@given(st.integers(0, 10_000))
def test_projections_take_points_to_the_image_and_back(seed):
    """A point's image place and depth, exact to 1e-9 in float64; the inverse; identities for a dropped pose."""
    cameras = _cameras(3, seed)
    there, back = view_matrices(reference_from_image(cameras, cameras.world_from_camera[0]))
    point = torch.tensor([0.3, -0.2, 0.5, 1], dtype=torch.float64)
    in_camera = (torch.linalg.inv(cameras.world_from_camera) @ cameras.world_from_camera[0] @ point)[:, :3]
    pixels = (cameras.intrinsics @ in_camera[..., None])[..., 0] * torch.tensor([2 / 64, 2 / 64, 1.0])
    pixels[:, :2] -= in_camera[:, 2:]
    torch.testing.assert_close(there @ point, torch.cat([pixels, torch.ones(3, 1)], 1).double(), rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(there @ back, torch.eye(4).double().expand(3, 4, 4), rtol=0, atol=1e-9)
    dropped = view_matrices(torch.zeros(2, 4, 4))
    assert torch.equal(torch.stack(dropped), torch.eye(4).expand(2, 2, 4, 4))


@given(st.integers(0, 10_000))
def test_attention_between_cameras_does_not_know_the_reference_frame(seed):
    """Only P_i P_j^-1 counts: another common frame, here even a projective one, gives the same output; another camera
    doesn't. Without views to compare (one camera, one place) it is plain attention."""
    g = torch.Generator().manual_seed(seed)
    there = torch.eye(4).double() + 0.3 * torch.randn(6, 4, 4, generator=g, dtype=torch.float64)
    frame = torch.eye(4).double() + 0.1 * torch.randn(4, 4, generator=g, dtype=torch.float64)
    attention = Attention(32, 2).double()
    tokens = torch.randn(2, 3 * 6, 32, generator=g, dtype=torch.float64)

    def attend(matrices):
        with torch.no_grad():
            return attention(tokens, None, ViewFrames(matrices, torch.linalg.inv(matrices)).at(2, 3))

    first = attend(there)
    scale = float(torch.linalg.cond(there).max() * torch.linalg.cond(frame))
    torch.testing.assert_close(attend(there @ frame), first, rtol=0, atol=1e-12 * scale**2)
    there[1, 0, 3] += 0.5
    assert (attend(there) - first).abs().max() > 1e-6
    same = ViewFrames(there[:1], torch.linalg.inv(there[:1])).at(1, 1)
    with torch.no_grad():
        torch.testing.assert_close(
            attention(tokens[:1, :1], None, same), attention(tokens[:1, :1]), rtol=0, atol=1e-12 * scale**2
        )


def test_paper_size_has_850_million_parameters():
    """Within 5% (the paper's figure), counted without allocating."""
    assert abs(count_parameters(SIZES["paper"].unet) / 850e6 - 1) < 0.05


def test_flops_are_those_of_convolutions_products_and_joint_attention():
    """Tiny network, by hand where it is easy: 3D attention adds 4 C ((V L)^2 - V L^2) for each block at each size."""
    views = 4
    joint = count_flops(tiny().unet, views)
    flat = count_flops(tiny(view_attention="none").unet, views)
    blocks = {(32, 64): 1 + 2, (64, 16): 1 + 1 + 2}  # (channels, tokens a view): blocks of down, middle, up
    extra = sum(4 * c * ((views * n) ** 2 - views * n**2) * count for (c, n), count in blocks.items())
    assert joint - flat == extra
    # Eight 64x64 views at paper size: SD's 2D network is 0.68 TFLOP an image (339 GMAC), joint attention adds some 20%.
    assert 5e12 < count_flops(SIZES["paper"].unet) < 8e12


@pytest.mark.parametrize("changes", [{}, {"relative_cameras": True}])
def test_odd_latent_sizes_and_bfloat16_run(changes):
    unet = random_model(**changes).unet
    latents, time, cameras, mask = inputs(1, 3, 1)
    with torch.no_grad():
        odd = unet(latents[..., :7, :5], time, cameras, mask)
        assert odd.shape == (1, 3, 8, 7, 5)
        full = unet(latents, time, cameras, mask)
        low = unet.to(torch.bfloat16)(latents, time, cameras, mask)
    assert low.dtype == torch.bfloat16
    # bfloat16 has 8 bits of mantissa; a few dozen layers of rounding.
    assert (low.float() - full).norm() / full.norm() < 0.05


def test_wrong_latent_channels_are_named():
    unet = random_model().unet
    latents, time, cameras, mask = inputs(1, 3, 1)
    with pytest.raises(ValueError, match="4 channels"):
        unet(latents[:, :, :4], time, cameras, mask)
