"""Parts of the plane sweep's network and of its losses, in closed form."""

from __future__ import annotations

import types

import pytest
import torch

from cat3d_core.matching import training
from cat3d_core.matching.composite import Composite
from cat3d_core.matching.layers import UNet
from cat3d_core.matching.losses import dissimilarity


def test_a_composite_takes_the_photos_share_by_the_confidence() -> None:
    g = torch.Generator().manual_seed(0)
    colour, sample = torch.rand(2, 2, 3, 4, 5, generator=g, dtype=torch.float64)
    confidence = torch.rand(2, 4, 5, generator=g, dtype=torch.float64)
    share = 1 / (1 + torch.exp(-(confidence - 0.4) / 0.2))[:, None]
    composite = Composite(0.4, 0.2)
    torch.testing.assert_close(composite(colour, confidence, sample), share * colour + (1 - share) * sample)
    assert Composite.from_json(composite.to_json()) == composite


def test_a_u_net_keeps_any_extent_and_starts_as_additive_skips() -> None:
    """Fresh residual blocks are the identity: with the ways up at zero, what comes out is what went in."""
    for dimensions, extent in ((2, (9, 14)), (3, (5, 6, 7))):
        net = UNet((8, 16, 24), dimensions)
        x = torch.randn(2, 8, *extent, generator=torch.Generator().manual_seed(1))
        assert net(x).shape == x.shape
        for up in net.up:
            for weight in up.parameters():
                torch.nn.init.zeros_(weight)
        torch.testing.assert_close(net(x), x)


def test_dissimilarity_is_one_minus_ssim_of_boxes() -> None:
    a, b = torch.rand(2, 1, 1, 5, 5, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    ma, mb = a.mean(), b.mean()
    both = ((a - ma) * (b - mb)).mean()
    luminance = (2 * ma * mb + 1e-4) / (ma**2 + mb**2 + 1e-4)
    contrast = (2 * both + 9e-4) / (a.var(correction=0) + b.var(correction=0) + 9e-4)
    torch.testing.assert_close(dissimilarity(a, b), 1 - luminance * contrast)
    wide = torch.rand(2, 3, 8, 9, generator=torch.Generator().manual_seed(3))
    torch.testing.assert_close(dissimilarity(wide, wide), torch.tensor(0.0), rtol=0, atol=1e-6)


def test_validation_is_the_mean_psnr_of_clamped_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Off by 0.1 everywhere: 20 dB; by 0.01: 40 dB; too bright where the truth is white: no error."""
    truth = torch.full((3, 3, 4, 4), 0.5)
    truth[2] = 1.0
    colour = truth + torch.tensor([0.1, -0.01, 0.7]).view(3, 1, 1, 1)
    monkeypatch.setattr(training, "forward", lambda network, batch: (types.SimpleNamespace(colour=colour), None))
    batch = types.SimpleNamespace(image=truth, truth=truth)
    found = training.validation_psnr(None, batch, "float32")  # type: ignore[arg-type]
    assert found == pytest.approx((20 + 40 + 100) / 3, abs=1e-3)
