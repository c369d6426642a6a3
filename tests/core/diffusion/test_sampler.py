"""Sampling: a view's result depends on its group alone; guidance, padding and refusals."""

from __future__ import annotations

import math

import pytest
import torch

from cat3d_core.diffusion import GuidanceConfig, SamplerConfig, sample
from cat3d_core.diffusion.conditioning import drop_condition, make_condition
from cat3d_core.diffusion.guidance import guided
from cat3d_core.diffusion.sampler import _pad_targets
from cat3d_core.random import normal
from tests.core.diffusion.models import matrices, random_model

FAST = SamplerConfig(steps=4)


def _groups(groups: int, given: int = 3, targets: int = 5) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    g = torch.Generator().manual_seed(1)
    latents = torch.randn(groups, given, 8, 8, 8, generator=g)
    cameras = matrices(groups, given + targets, g)
    noise = torch.stack(
        [
            torch.stack([normal((8, 8, 8), 0, "scene", i * targets + j, "noise") for j in range(targets)])
            for i in range(groups)
        ]
    )
    return latents, cameras, noise


@pytest.mark.parametrize("solver", ["ddim", "dpm++", "unipc"])
def test_results_do_not_depend_on_group_count_or_order(solver):
    """Within 1e-5 (float32) in one batch; bit for bit with micro-batches of one."""
    model = random_model()
    latents, cameras, noise = _groups(3)
    order = torch.tensor([2, 0, 1])
    for micro, tolerance in ((None, 1e-5), (2, 1e-5), (1, 0.0)):
        config = SamplerConfig(solver, steps=3, micro_batch=micro)
        full = sample(model, latents, cameras, noise, config)
        alone = torch.cat([sample(model, latents[i, None], cameras[i, None], noise[i, None], config) for i in range(3)])
        shuffled = sample(model, latents[order], cameras[order], noise[order], config)
        assert (full - alone).abs().max() <= tolerance
        assert (full[order] - shuffled).abs().max() <= tolerance


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_micro_batches_of_one_are_bit_identical(dtype):
    model = random_model()
    model.unet.to(dtype)
    latents, cameras, noise = _groups(3)
    config = SamplerConfig(steps=3, micro_batch=1)
    full = sample(model, latents, cameras, noise, config)
    assert full.dtype == torch.float32
    assert torch.equal(full[2:], sample(model, latents[2:], cameras[2:], noise[2:], config))


def test_guidance_one_and_outside_the_interval_is_the_conditional_prediction():
    model = random_model()
    latents, cameras, noise = _groups(2)

    def run(**guidance):
        return sample(model, latents, cameras, noise, SamplerConfig(steps=4, guidance=GuidanceConfig(**guidance)))

    plain = run(scale=1.0)
    assert torch.equal(run(scale=3.0, low_log_snr=50.0), plain)
    assert not torch.allclose(run(scale=3.0), plain)
    assert not torch.allclose(run(scale=3.0, drop="images"), run(scale=3.0))


def test_guidance_formula_and_what_is_dropped():
    condition = make_condition(torch.ones(2, 1, 3, 4, 4), torch.ones(2, 3, 4, 4))
    assert condition.mask.tolist() == [[1, 0, 0]] * 2
    seen = []

    def predict(given, x):
        seen.append(given)
        return given.latents.mean((1, 2, 3, 4))[:, None, None, None, None] * 2 + given.cameras.mean() + 0 * x

    x = torch.zeros(2, 2, 3, 4, 4)
    out = guided(predict, condition, x, 0.0, GuidanceConfig(3.0, drop="images"))
    torch.testing.assert_close(out, torch.full_like(out, 0 + 3 * 2 + 1.0))
    assert seen[0].latents.shape[0] == 4
    assert seen[0].latents[2:].abs().sum() == 0
    assert seen[0].mask[2:].sum() == 0
    assert seen[0].cameras[2:].min() == 1
    guided(predict, condition, x, 9.0, GuidanceConfig(3.0, high_log_snr=5.0))
    assert seen[1].latents.shape[0] == 2
    everything = drop_condition(condition, torch.tensor([True, False]), "images_and_poses")
    assert everything.cameras[0].abs().sum() == 0
    assert torch.equal(everything.cameras[1], condition.cameras[1])


def test_short_groups_are_padded_to_the_trained_size():
    model = random_model()
    latents, cameras, noise = _groups(1, 3, 2)
    padded_cameras, padded_noise = _pad_targets(cameras, noise, 5)
    assert torch.equal(padded_cameras[:, 3:], cameras[:, 3:][:, [0, 1, 0, 1, 0]])
    assert torch.equal(padded_noise[:, :2], noise)
    flat = padded_noise[0].flatten(1)
    correlation = torch.corrcoef(flat) - torch.eye(5)
    assert correlation.abs().max() < 6 / math.sqrt(flat.shape[1])
    short = sample(model, latents, cameras, noise, FAST)
    full = sample(model, latents, padded_cameras, padded_noise, FAST)
    assert torch.equal(short, full[:, :2])


def test_wrong_shapes_and_too_many_views_are_refused():
    model = random_model()
    latents, cameras, noise = _groups(1, 3, 5)
    with pytest.raises(ValueError, match="need cameras"):
        sample(model, latents, cameras[:, :7], noise, FAST)
    latents, cameras, noise = _groups(1, 3, 6)
    with pytest.raises(ValueError, match="at most 8 views"):
        sample(model, latents, cameras, noise, FAST)


def test_a_network_that_knows_the_answer_gives_it():
    """With the exact v of a fixed clean latent every solver and every set of nodes arrives at it (1e-4)."""
    model = random_model()
    latents, cameras, noise = _groups(1)
    truth = torch.randn_like(noise)

    class Exact(torch.nn.Module):
        def forward(self, x, time, cameras, mask, hints=None):
            # With exact predictions x stays on alpha clean + sigma noise: read the two amplitudes off it.
            basis = torch.stack([truth.flatten(), noise.flatten()], 1).double()
            alpha, sigma = torch.linalg.lstsq(basis, x[:, 3:].flatten()[:, None].double()).solution[:, 0].tolist()
            return torch.cat([x[:, :3], alpha * noise - sigma * truth], 1)

    model.unet = Exact()
    for solver in ("ddim", "dpm++", "unipc"):
        for nodes in ("trailing", "linspace", "log_snr", "karras"):
            config = SamplerConfig(solver, nodes, 6, GuidanceConfig(1.0))
            got = sample(model, latents, cameras, noise, config)
            torch.testing.assert_close(got, truth, rtol=0, atol=1e-4)


def test_the_reference_is_the_papers_and_unknown_solvers_are_refused():
    """CAT3D, section 3.1: DDIM, 50 steps, guidance 3."""
    config = SamplerConfig.reference()
    assert (config.solver, config.nodes, config.steps, config.guidance.scale) == ("ddim", "trailing", 50, 3.0)
    with pytest.raises(ValueError, match="euler"):
        SamplerConfig("euler")
