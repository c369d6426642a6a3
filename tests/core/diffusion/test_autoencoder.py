"""Our autoencoder."""

from __future__ import annotations

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
