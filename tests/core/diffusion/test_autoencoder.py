"""Our autoencoder."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from cat3d_core.diffusion import SIZES, Autoencoder, autoencoder_loss


def _pictures(count: int, size: int = 32, seed: int = 0) -> torch.Tensor:
    """Smooth colour fields in [0, 1]."""
    g = torch.Generator().manual_seed(seed)
    return torch.nn.functional.interpolate(torch.rand(count, 3, 3, 3, generator=g), (size, size), mode="bilinear")


def test_shapes_and_normalisation():
    torch.manual_seed(0)
    autoencoder = Autoencoder(SIZES["tiny"].autoencoder).requires_grad_(False)
    images = _pictures(16)
    autoencoder.calibrate(images)
    latents = autoencoder.encode(images)
    assert latents.shape == (16, 8, 4, 4)
    assert latents.mean((0, 2, 3)).abs().max() < 1e-4
    assert latents.std((0, 2, 3)).max() < 1.01
    decoded = autoencoder.decode(latents)
    assert decoded.shape == images.shape
    assert decoded.min() >= 0
    assert decoded.max() <= 1
    raw = autoencoder.posterior(images)[0]
    torch.testing.assert_close(autoencoder.decode_raw(raw).clamp(0, 1), decoded, rtol=0, atol=1e-5)
    with pytest.raises(ValueError, match="multiples of 8"):
        autoencoder.encode(images[..., :30])


def test_the_linear_start_is_the_best_projection_of_blocks():
    """Against the singular value decomposition in float64: what the components leave over is the least possible."""
    images = torch.rand(64, 3, 32, 32, generator=torch.Generator().manual_seed(3)).double()
    images = images * torch.linspace(0.2, 1, 32).double() + 0.3 * images.mean((1, 2, 3), keepdim=True)  # uneven, > 192
    images = (images / images.max()).clamp(0, 1)
    blocks = torch.nn.functional.unfold(images * 2 - 1, 8, stride=8).transpose(1, 2).flatten(0, 1)
    values = torch.linalg.svdvals(blocks - blocks.mean(0))
    autoencoder = Autoencoder(dataclasses.replace(SIZES["tiny"].autoencoder, linear=True)).double()
    autoencoder.start_linear(images)
    latents = autoencoder.posterior(images)[0]
    with torch.no_grad():
        decoded = autoencoder.decode_raw(latents)
    left = ((decoded - images) * 2).square().sum()
    # `synthesis` has one bias per colour, not per place in a block: the mean block's own shape is all it may lose.
    mean = blocks.mean(0).reshape(3, 64)
    shape = (mean - mean.mean(1, keepdim=True)).square().sum() * len(blocks)
    assert values[8:].square().sum() * 0.999 <= left <= (values[8:].square().sum() + shape) * 1.001
    variance = latents.detach().var((0, 2, 3))
    expected = values[:8] / (len(blocks) - 1) ** 0.5  # of std s_i, kept at s_i ** 0.5
    torch.testing.assert_close(variance, expected, rtol=2e-3, atol=0)
    autoencoder.calibrate(images)
    scaled = autoencoder.encode(images).detach()
    assert scaled.var((0, 2, 3))[0] > scaled.var((0, 2, 3))[-1], "one scale for all channels"
    with pytest.raises(ValueError, match="too few"):
        autoencoder.start_linear(images[:2])


def test_kl_term_is_the_closed_form():
    torch.manual_seed(0)
    autoencoder = Autoencoder(SIZES["tiny"].autoencoder)
    images = _pictures(2)
    mean, log_variance = autoencoder.posterior(images)
    posterior = torch.distributions.Normal(mean, (0.5 * log_variance).exp())
    expected = torch.distributions.kl_divergence(posterior, torch.distributions.Normal(0.0, 1.0)).sum((1, 2, 3)).mean()
    _, numbers = autoencoder_loss(autoencoder, images, torch.zeros_like(mean))
    assert numbers["kl"] == pytest.approx(float(expected), rel=1e-4)


def test_it_learns():
    """Two pictures by heart: some 10 dB in 100 steps."""
    torch.manual_seed(0)
    autoencoder = Autoencoder(SIZES["tiny"].autoencoder)
    optimizer = torch.optim.AdamW(autoencoder.parameters(), 4e-3)
    images, noise = _pictures(2), torch.zeros(2, 8, 4, 4)
    history = []
    for _ in range(100):
        loss, numbers = autoencoder_loss(autoencoder, images, noise)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        history.append(numbers["psnr"])
    assert history[-1] > history[0] + 8


@pytest.mark.parametrize("linear", [False, True])
def test_calibrated_latents_have_unit_variance(linear: bool) -> None:
    """Each channel by itself, or with `linear` all of them together; the posterior's own spread is part of it."""
    torch.manual_seed(0)
    autoencoder = Autoencoder(dataclasses.replace(SIZES["tiny"].autoencoder, linear=linear)).requires_grad_(False)
    images = _pictures(16, seed=2)
    autoencoder.calibrate(images)
    own = autoencoder.posterior(images)[1].double().exp().mean((0, 2, 3)) / autoencoder.latent_std.double().square()
    variance = autoencoder.encode(images).double().var((0, 2, 3)) + own
    variance = variance.mean() if linear else variance
    torch.testing.assert_close(variance, torch.ones_like(variance), rtol=1e-4, atol=0)


def test_the_loss_is_the_weighted_sum_of_its_terms():
    """Each term by itself, in float64: what a weight adds is that weight times the term."""
    torch.manual_seed(0)
    autoencoder = Autoencoder(SIZES["tiny"].autoencoder).double().requires_grad_(False)
    images = _pictures(3, seed=5).double()
    noise = torch.randn(3, 8, 4, 4, generator=torch.Generator().manual_seed(1)).double()
    mean, log_variance = autoencoder.posterior(images)
    decoded = autoencoder.decode_raw(mean + (log_variance / 2).exp() * noise)
    edges = (decoded - images).diff(dim=-1).abs().mean() + (decoded - images).diff(dim=-2).abs().mean()
    kl = 0.5 * (mean**2 + log_variance.exp() - 1 - log_variance).sum((1, 2, 3)).mean()

    def loss(**weights: float) -> float:
        settings = {"kl_weight": 0.0, "gradient_weight": 0.0, "perceptual_weight": 0.0} | weights
        far = lambda a, b: (a - b).abs().sum((1, 2, 3))  # noqa: E731
        return float(autoencoder_loss(autoencoder, images, noise, perceptual=far, **settings)[0])

    plain = loss()
    assert plain == pytest.approx(float((decoded - images).abs().mean()), rel=1e-5)
    assert loss(kl_weight=0.01) - plain == pytest.approx(0.01 * float(kl), rel=1e-4)
    assert loss(gradient_weight=0.5) - plain == pytest.approx(0.5 * float(edges), rel=1e-4)
    apart = float((decoded.clamp(0, 1) - images).abs().sum((1, 2, 3)).mean())
    assert loss(perceptual_weight=0.1) - plain == pytest.approx(0.1 * apart, rel=1e-4)
