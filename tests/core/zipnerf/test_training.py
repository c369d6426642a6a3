"""Compositing, losses, optimiser, training: exactness, determinism, resume, and what happens to non-finite steps."""

import dataclasses
import math

import pytest
import torch

from cat3d_core.cameras import Cameras
from cat3d_core.rays import image_rays
from cat3d_core.reconstruction import NonFiniteError, Views, draw_batch, normals_from_depth
from cat3d_core.zipnerf import PRESETS, Field, Trainer, losses, render_image
from cat3d_core.zipnerf import adam as adam_module
from cat3d_core.zipnerf.adam import Adam
from cat3d_core.zipnerf.field import encode_directions
from cat3d_core.zipnerf.gradients import safe_exp
from cat3d_core.zipnerf.render import Round, near_gradient_scale, render_rays, weights_from_density

TINY = dataclasses.replace(PRESETS["tiny"], iterations=30, warmup_iterations=3, batch_rays=256)


def _cameras(count: int = 4, width: int = 24, height: int = 20) -> Cameras:
    """Cameras on a ring of radius 1 around the origin, looking at it, +z up."""
    angle = torch.arange(count) * (2 * math.pi / max(count, 3))
    center = torch.stack([angle.cos(), angle.sin(), torch.full_like(angle, 0.3)], -1)
    forward = torch.nn.functional.normalize(-center, dim=-1)
    right = torch.nn.functional.normalize(
        torch.linalg.cross(forward, torch.tensor([[0.0, 0.0, 1.0]]).expand(count, 3)), dim=-1
    )
    down = torch.linalg.cross(forward, right)
    pose = torch.eye(4).repeat(count, 1, 1)
    pose[:, :3, :3] = torch.stack([right, down, forward], -1)
    pose[:, :3, 3] = center
    k = torch.tensor([[30.0, 0, width / 2], [0, 30, height / 2], [0, 0, 1]]).repeat(count, 1, 1)
    return Cameras(k, pose, torch.tensor([[width, height]]).repeat(count, 1))


def _views(count: int = 4, captured: int | None = None) -> Views:
    """Images of a coloured ball on a grey ground, drawn analytically."""
    cameras = _cameras(count)
    images = []
    for index in range(count):
        rays = image_rays(cameras, index)
        direction = torch.nn.functional.normalize(rays.directions, dim=-1)
        b = (rays.origins * direction).sum(-1)
        root = b.square() - rays.origins.square().sum(-1) + 0.3**2
        point = rays.origins + (-b - root.clamp_min(0).sqrt())[:, None] * direction
        rgb = torch.where((root > 0)[:, None], 0.5 + point / 0.6, 0.6)
        images.append((rgb.clamp(0, 1) * 255).to(torch.uint8).view(20, 24, 3))
    flags = torch.arange(count) < (count if captured is None else captured)
    return Views.from_images(cameras, images, flags)


def test_thin_fog_keeps_its_weight() -> None:
    t = torch.tensor([[0.0, 1.0, 2.0]])
    direction = torch.tensor([[0.0, 0.0, 1.0]])
    for density in (1e-12, 1e-8, 1e-3, 1.0, 30.0, 1e17):
        weights = weights_from_density(torch.full((1, 2), density), t, direction)
        exact = torch.tensor([-math.expm1(-density), -math.expm1(-density) * math.exp(-density)])
        torch.testing.assert_close(weights[0], exact, rtol=1e-6, atol=0)


def test_compositing_gradient_is_finite_over_magnitudes() -> None:
    raw = torch.linspace(-120, 120, 400).view(40, 10).requires_grad_()
    t = torch.cat([torch.zeros(1), 10 ** torch.linspace(-4, 6, 10)]).expand(40, 11)
    weights = weights_from_density(safe_exp(raw), t, torch.ones(40, 3))
    assert torch.isfinite(weights).all()
    assert (weights.sum(-1) <= 1 + 1e-5).all()
    weights.square().sum().backward()
    assert raw.grad is not None
    assert torch.isfinite(raw.grad).all()
    double = torch.rand((4, 6), dtype=torch.float64, requires_grad=True)
    edges = torch.linspace(0, 2, 7, dtype=torch.float64).expand(4, 7)
    assert torch.autograd.gradcheck(
        lambda d: weights_from_density(d, edges, torch.ones(4, 3, dtype=torch.float64)), (double,)
    )


def test_losses_are_finite_with_finite_gradients() -> None:
    generator = torch.Generator().manual_seed(0)
    s = torch.linspace(0, 1, 33).expand(50, 33)
    for magnitude in (0.0, 1e-30, 1e-7, 1.0):
        weights = (torch.rand((50, 32), generator=generator) / 32 * magnitude).requires_grad_()
        final_weights = torch.zeros(50, 32)
        final_weights[:, 7] = 1.0
        final = Round(s, s * 1e6, final_weights.requires_grad_())
        total = losses.interlevel([Round(s, s, weights)], final, (0.03,)) + losses.distortion(final, TINY)
        total.backward()
        assert torch.isfinite(total)
        assert weights.grad is not None
        assert torch.isfinite(weights.grad).all()
        assert final_weights.grad is not None
        assert torch.isfinite(final_weights.grad).all()
    assert losses.charbonnier(torch.tensor([0.0, 3.0]), 1e-3).tolist() == pytest.approx([1e-3, 3.0], rel=1e-6)


def test_interlevel_is_zero_for_a_proposal_that_covers_the_surface() -> None:
    s = torch.linspace(0, 1, 33).expand(2, 33)
    weights = torch.zeros(2, 32)
    weights[:, 16] = 1.0
    cover = torch.full((2, 32), 1.0, requires_grad=True)
    assert losses.interlevel([Round(s, s, cover)], Round(s, s, weights), (0.03,)) == 0
    miss = torch.full((2, 32), 1e-3, requires_grad=True)
    loss = losses.interlevel([Round(s, s, miss)], Round(s, s, weights), (0.03,))
    loss.backward()
    assert loss > 0
    assert miss.grad is not None
    assert (miss.grad <= 0).all()


def test_generated_views_lose_weight_with_distance_and_time() -> None:
    centers = torch.tensor([[0.0, 0, 0], [0.1, 0, 0], [0.5, 0, 0]])
    captured = torch.tensor([True, False, False])
    config = dataclasses.replace(TINY, distance_falloff=15.0, generated_weight_final=0.5)
    assert losses.view_weights(centers, captured, config, 0.0).tolist() == [1, 1, 1]
    end = losses.view_weights(centers, captured, config, 1.0)
    assert end.tolist() == pytest.approx([1, 0.5 * math.exp(-0.15), 0.5 * math.exp(-15 * 0.25)], rel=1e-5)


@pytest.mark.parametrize("kernel", [True, False])
def test_adam_matches_torch_and_decays_untouched_entries(kernel: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    if not kernel:
        monkeypatch.setattr(adam_module, "library", lambda name: None)
    generator = torch.Generator().manual_seed(0)
    start = torch.randn((64, 4), generator=generator) * 1e-3
    own, other = start.clone().requires_grad_(), start.double().requires_grad_()
    adam = Adam({"table": own}, {"table": [(0, 16, 0.1), (16, 64, 0.1)]}, 0.9, 0.99, 1e-15)
    reference = torch.optim.Adam([other], lr=1e-3, betas=(0.9, 0.99), eps=1e-15)
    for _ in range(20):
        gradient = torch.randn((64, 4), generator=generator) * 1e-4
        gradient[32:] = 0  # no ray touches these
        own.grad = gradient.clone()
        decay = torch.cat([other[:16].detach() * 0.1 / 64, other[16:].detach() * 0.1 / 192])
        other.grad = gradient.double() + decay
        assert adam.step(1e-3)
        reference.step()
    torch.testing.assert_close(own.double(), other, rtol=0, atol=2e-6)
    assert own[32:].abs().mean() < start[32:].abs().mean()
    before = {name: value.clone() for name, value in adam.state().items()}
    own.grad = torch.full_like(own, 2e19)  # its square is no float32 number
    assert not adam.step(1e-3)
    assert all(torch.equal(value, before[name]) for name, value in adam.state().items())


def test_direction_encoding() -> None:
    unit = torch.tensor([[0.6, 0.0, 0.8]])
    encoded = encode_directions(unit, 2)[0]
    expected = [0.6, 0, 0.8, *(f(k * v) for f in (math.sin, math.cos) for k in (1, 2) for v in (0.6, 0.0, 0.8))]
    assert encoded.tolist() == pytest.approx(expected, rel=1e-6, abs=1e-7)


def test_normals_of_a_plane_face_the_camera() -> None:
    rays = image_rays(_cameras(1, 12, 10), 0)
    normal = torch.nn.functional.normalize(torch.tensor([1.0, 0.2, 0.3]), dim=0)
    depth = (-(rays.origins @ normal) / (rays.directions @ normal)).view(10, 12)
    got = normals_from_depth(depth, rays)
    torch.testing.assert_close(
        got, (normal * torch.sign(rays.origins[0] @ normal)).expand(10, 12, 3), rtol=0, atol=1e-3
    )


def test_patches_lie_inside_mixed_sizes_and_captured_views_are_emphasised() -> None:
    cameras = Cameras.cat([_cameras(1, 24, 20), _cameras(1, 17, 30), _cameras(1, 40, 16)])
    images = [torch.full((int(h), int(w), 3), i, dtype=torch.uint8) for i, (w, h) in enumerate(cameras.size)]
    views = Views.from_images(cameras, images, torch.tensor([True, False, False]))
    batch = draw_batch(views, 400, 16, 0.8, torch.Generator().manual_seed(0))
    size = views.size[batch.view]
    assert (batch.xy >= 0).all()
    assert (batch.xy < size).all()
    torch.testing.assert_close(batch.rgb[:, 0] * 255, batch.view.float())  # each pixel from its own view
    assert 0.7 < (batch.view == 0).float().mean() < 0.9
    with pytest.raises(ValueError, match="lower patch_size"):
        draw_batch(views, 1, 32, 0.1, torch.Generator())


def test_single_pixels_are_drawn_from_those_that_count_alike() -> None:
    views = _views(3, captured=1)
    kept = torch.ones(len(views.pixels), dtype=torch.bool)
    kept[480:960] = torch.arange(480) % 48 == 5  # ten pixels of the second view
    kept[960:] = False  # none of the third
    some = views.only(kept)
    assert some.counting.tolist() == [480, 10, 0]
    assert views.valid is None, "the others stay as they are"
    batch = draw_batch(some, 4000, 1, 0.5, torch.Generator().manual_seed(0))
    assert batch.valid.all()
    flat = some.offset[batch.view] + batch.xy[:, 1] * some.size[batch.view, 0] + batch.xy[:, 0]
    counts = torch.bincount(flat, minlength=len(kept))
    assert not counts[~kept].any()
    assert counts[:480].float().mean() == pytest.approx(8.2, abs=0.1), "480 to about 10 of 490: more than half"
    assert (counts[480:960][kept[480:960]] > 0).all()
    patches = draw_batch(some, 200, 8, 0.5, torch.Generator().manual_seed(0))
    assert (patches.view < 2).all(), "no patch from a view without a pixel that counts"
    nothing = views.only(torch.zeros_like(kept))
    assert not draw_batch(nothing, 8, 1, 0.5, torch.Generator().manual_seed(0)).valid.any()


def test_views_name_the_view_that_does_not_fit() -> None:
    cameras = _cameras(2)
    good = torch.zeros((20, 24, 3), dtype=torch.uint8)
    with pytest.raises(ValueError, match="view 1"):
        Views.from_images(cameras, [good, good[:10]], torch.ones(2, dtype=torch.bool))
    with pytest.raises(ValueError, match="mask of view 0"):
        Views.from_images(cameras, [good, good], torch.ones(2, dtype=torch.bool), [good[:3, :, 0] > 0, None])


def test_training_learns_and_is_identical_for_a_seed_and_after_resume() -> None:
    runs = []
    for interrupted in (False, False, True):
        trainer = Trainer(TINY, _views(), seed=3)
        history = [trainer.step() for _ in range(12)]
        if interrupted:
            state = trainer.state()
            trainer = Trainer(TINY, _views(), seed=3)
            trainer.load_state(state)
        history += [trainer.step() for _ in range(18)]
        runs.append((trainer.state(), history))
    for state, history in runs[1:]:
        assert history == runs[0][1]
        assert state.keys() == runs[0][0].keys()
        assert all(torch.equal(value, runs[0][0][name]) for name, value in state.items())
    history = runs[0][1]
    assert history[-1]["psnr"] > history[0]["psnr"] + 3
    assert history[-1]["skipped"] == 0
    other = Trainer(TINY, _views(), seed=4)
    assert not torch.equal(other.step()["photometric"] * torch.ones(1), history[0]["photometric"] * torch.ones(1))


def test_patches_with_a_perceptual_loss_and_generated_views_train() -> None:
    def distance(prediction: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        assert prediction.shape[1:] == (3, 16, 16)
        return (prediction - target).square().mean((1, 2, 3))

    config = dataclasses.replace(TINY, batch_rays=1024, patch_size=16, patch_share=0.5, chunk_rays=300)
    trainer = Trainer(config, _views(4, captured=2), seed=0, perceptual=distance)
    terms = [trainer.step() for _ in range(3)][-1]
    assert {"photometric", "distortion", "interlevel", "perceptual"} <= terms.keys()
    assert all(math.isfinite(value) for value in terms.values())


def test_low_resolution_first() -> None:
    config = dataclasses.replace(TINY, low_resolution_iterations=1)
    trainer = Trainer(config, _views(), seed=0)
    assert [math.isfinite(trainer.step()["loss"]) for _ in range(2)] == [True, True]


def test_plateau_of_held_out_pixels_ends_training_and_survives_resume() -> None:
    config = dataclasses.replace(
        TINY, iterations=1000, plateau_patience=1, plateau_every=2, lr_init=1e-9, lr_final=1e-9
    )
    trainer = Trainer(config, _views(), seed=0)
    while not trainer.finished:
        trainer.step()
    assert trainer.iteration < 200
    again = Trainer(config, _views(), seed=0)
    again.load_state(trainer.state())
    assert again.finished


def test_masked_pixels_do_not_count() -> None:
    views = _views(2)
    black = [torch.zeros(20, 24, dtype=torch.bool)] * 2
    images = [views.pixels[i * 480 : (i + 1) * 480].view(20, 24, 3) for i in range(2)]
    trainer = Trainer(TINY, Views.from_images(views.cameras, images, views.captured, black), seed=0)
    assert trainer.step()["photometric"] == 0


def test_a_non_finite_step_is_skipped_counted_and_in_the_end_named() -> None:
    trainer = Trainer(dataclasses.replace(TINY, max_skipped_steps=2), _views(), seed=0)
    trainer.step()
    with torch.no_grad():
        trainer.field.colour.rgb.bias[0] = math.nan
    before = trainer.state()
    assert trainer.step()["skipped"] == 1
    after = trainer.state()
    changed = [
        n
        for n in before
        if n.startswith(("field", "adam")) and not torch.equal(before[n].nan_to_num(9), after[n].nan_to_num(9))
    ]
    assert not changed
    trainer.step()
    with pytest.raises(NonFiniteError, match=r"view \d+ pixel .* views of this batch"):
        trainer.step()


def test_state_that_does_not_fit_is_refused() -> None:
    trainer = Trainer(TINY, _views(), seed=0)
    state = trainer.state()
    with pytest.raises(ValueError, match="does not fit this config"):
        Trainer(dataclasses.replace(TINY, grid_log2_table=12), _views(), seed=0).load_state(state)
    with pytest.raises(ValueError, match="does not fit this reconstruction config"):
        Field.from_state(dataclasses.replace(TINY, grid_log2_table=12), state)


def test_rendering_is_deterministic_and_reports_progress() -> None:
    trainer = Trainer(TINY, _views(), seed=0)
    for _ in range(10):
        trainer.step()
    field = Field.from_state(TINY, trainer.state())
    seen: list[float] = []
    first = render_image(field, trainer.views.cameras, 1, TINY, chunk=100, on_progress=seen.append)
    second = render_image(trainer.field, trainer.views.cameras, 1, TINY, chunk=4096)
    assert first.image.shape == (20, 24, 3)
    assert seen[-1] == 1.0
    for a, b in zip(vars(first).values(), vars(second).values(), strict=True):
        assert torch.isfinite(a).all()
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-3)
    preview = render_image(field, trainer.views.cameras, 1, dataclasses.replace(TINY, samples=(8, 6)))
    assert torch.isfinite(preview.image).all()
    small = render_image(field, trainer.views.cameras, 1, TINY, resolution_scale=0.5)
    assert small.depth.shape == (10, 12)


@pytest.mark.parametrize("distance", [1e-9, 1e-3, 1.0, 1e6, 1e12])
def test_normals_of_a_plane_at_any_distance(distance: float) -> None:
    """Found by `cat3d stress`: the product of two steps overflowed beyond 1e10 and underflowed below 1e-9 (float32)."""
    camera = _cameras(1)
    rays = image_rays(camera, 0)
    rays = rays._replace(origins=torch.zeros_like(rays.origins))  # next to an origin at 1, 1e-9 would be rounding
    normals = normals_from_depth(torch.full((20, 24), distance), rays)
    torch.testing.assert_close(normals, (-camera.forward[0]).expand(20, 24, 3), rtol=0, atol=1e-4)


def test_near_gradients_are_scaled_and_nothing_else_changes() -> None:
    near, plain = (dataclasses.replace(TINY, near_gradient=on) for on in (True, False))
    cameras = _views().cameras
    rays = image_rays(cameras, 0)
    field = Field(TINY, seed=1)
    found = []
    for config, reach in ((plain, 1.0), (near, 1.0), (near, 1e-3)):
        # Within `reach` of the camera everything is seen: at t = 1e-3 gradients shrink by 1e-6 at least.
        config = dataclasses.replace(config, far=reach, near=0.0)
        field.zero_grad(set_to_none=True)
        out = render_rays(field, rays, config=config)
        out.rgb.square().sum().backward()
        found.append((out.rgb.detach(), field.colour.rgb.weight.grad))
    assert torch.equal(found[0][0], found[1][0])
    assert found[1][1].norm() < found[0][1].norm()
    assert 0 < found[2][1].norm() < 1e-5 * found[0][1].norm()
    t = torch.tensor([[0.0, 0.2, 3.0, 5.0]])
    scale = near_gradient_scale(t, torch.tensor([[0.0, 0.0, 2.0]]))
    assert scale[0].tolist() == pytest.approx([0.04, 1.0, 1.0])


def test_an_empty_scene_shows_a_grey_between_the_backgrounds_levels() -> None:
    """At random for each ray with a generator, half-way between the levels without one."""
    config = dataclasses.replace(TINY, background=(0.2, 0.6), far=1e-6, near=0.0)  # too short to meet anything
    rays = image_rays(_views().cameras, 0)
    field = Field(TINY, seed=1)
    with torch.no_grad():
        plain = render_rays(field, rays, config=config)
        drawn = render_rays(field, rays, config=config, generator=torch.Generator().manual_seed(0))
    assert float(plain.opacity.max()) < 1e-3
    torch.testing.assert_close(plain.rgb, torch.full_like(plain.rgb, 0.4), rtol=0, atol=1e-3)
    assert float(drawn.rgb.min()) > 0.199
    assert float(drawn.rgb.max()) < 0.601
    assert float(drawn.rgb[:, 0].std()) == pytest.approx(0.4 / 12**0.5, rel=0.1)
    assert float((drawn.rgb[:, 0] - drawn.rgb[:, 2]).abs().max()) < 1e-3
