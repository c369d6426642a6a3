"""The C++ kernels against their plain torch references in float64, values and gradients."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from cat3d_core.matching import warp_cpu
from cat3d_core.matching.targets import gather_reference, pool_reference
from cat3d_core.matching.warp import Maps, pair_maps, views
from tests.core.strategies import orbit

pytestmark = pytest.mark.skipif(not warp_cpu.available(torch.zeros(1)), reason="no C++ compiler is here")
NEAREST = 10.0


def numbers(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def case(count: int, width: int) -> tuple[Tensor, Tensor, Tensor, Maps, Tensor]:
    cameras = views(orbit(5, width=64, height=48))
    photos = torch.tensor([[0, 2, 3], [3, 1, 2]])[:, :count]
    features, position = numbers(4, 5, 6, 8), torch.rand(4, 1, 12, 16, dtype=torch.float64)
    own = torch.cat([position, -2 + 0.5 * numbers(4, 1, 12, 16, seed=1)], 1)
    depth = torch.rand(2, 4, 7, width, generator=torch.Generator().manual_seed(2), dtype=torch.float64) * 3
    depth[:, 0] = 0
    return features, own, photos, pair_maps(cameras[[0, 4]], cameras[photos], torch.float64), depth


@pytest.mark.parametrize(("count", "width"), [(1, 16), (3, 16), (3, 5), (2, 33)])
def test_gather_is_the_reference(count: int, width: int) -> None:
    features, own, photos, maps, depth = case(count, width)
    features.requires_grad_()
    own.requires_grad_()
    expected = gather_reference(features, own, photos, maps, depth, NEAREST)
    single = Maps(*(t.float() for t in maps))
    f, o = (t.detach().float().requires_grad_() for t in (features, own))
    found = warp_cpu.gather(f, o, photos, single, depth.float(), NEAREST)
    # A point on an image's border, or between two pixels, may fall to either side in single precision.
    same = found[1] == expected.valid
    assert float(same.float().mean()) > 0.999
    close = (found[0] - expected.voxels).abs().amax(-1) < 2e-4
    assert float(close.float().mean()) > 0.995
    torch.testing.assert_close(found[2].double()[close], expected.agreement[close], rtol=0, atol=2e-3)
    # Gradients of what is the same on both sides.
    weight = numbers(*expected.voxels.shape, seed=3) * close[..., None]
    weight_of_agreement = numbers(*expected.agreement.shape, seed=4) * close
    ((expected.voxels * weight).sum() + (expected.agreement * weight_of_agreement).sum()).backward()
    ((found[0] * weight).sum() + (found[2] * weight_of_agreement).sum()).backward()
    for exact, single_one in ((features, f), (own, o)):
        assert exact.grad is not None
        assert single_one.grad is not None
        scale = float(exact.grad.abs().max())
        torch.testing.assert_close(single_one.grad.double(), exact.grad, rtol=0, atol=2e-3 * scale)


@pytest.mark.parametrize("count", [1, 4])
def test_pool_is_the_reference(count: int) -> None:
    hidden = 2 * numbers(2, count, 3, 5, 7, 9)
    valid = (torch.rand(2, count, 3, 5, 7, generator=torch.Generator().manual_seed(1)) < 0.6).double()
    hidden[:, :, 0, 0, :, 0] = -40  # weights at their least
    exact = hidden.clone().requires_grad_()
    expected = pool_reference(exact, valid)
    single = hidden.float().requires_grad_()
    found = warp_cpu.pool(single, valid.float())
    torch.testing.assert_close(found.double(), expected, rtol=0, atol=2e-5)
    weight = numbers(*expected.shape, seed=5)
    (expected * weight).sum().backward()
    (found * weight).sum().backward()
    assert single.grad is not None
    torch.testing.assert_close(single.grad.double(), exact.grad, rtol=2e-3, atol=2e-3)


def test_kernels_are_the_same_on_every_run() -> None:
    features, own, photos, maps, depth = case(3, 33)
    gradients = []
    for _ in range(2):
        f = features.float().requires_grad_()
        found = warp_cpu.gather(f, own.float(), photos, Maps(*(t.float() for t in maps)), depth.float(), NEAREST)
        found[0].square().sum().backward()
        gradients.append(f.grad)
    assert torch.equal(*gradients)
