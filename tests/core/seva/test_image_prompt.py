"""The image embedding of a window: preprocessing as the original's, by a plain reference, and the raw CLIP output."""

from __future__ import annotations

import math

import pytest
import torch
from safetensors.torch import load_file

from cat3d_core.metrics.clip import ClipConfig, ClipImageTower, normalized
from cat3d_core.seva.image_prompt import context, embed, squashed

ROWS = [0, 55, 111, 223]


def test_preprocessing_agrees_with_the_original(shared_fixtures):
    f = load_file(shared_fixtures / "seva_sampling.safetensors")
    squeezed = squashed((f["clip.image"].float() + 1) / 2, 224)
    torch.testing.assert_close(2 * squeezed[:, :, ROWS] - 1, f["clip.resized_rows_0_55_111_223"], rtol=0, atol=1e-5)
    torch.testing.assert_close(
        normalized(squeezed)[:, :, ROWS], f["clip.normalised_rows_0_55_111_223"], rtol=0, atol=1e-5
    )


def _reference(line: list[float], size: int) -> list[float]:
    """One line, in Python: Gaussian with reflected borders, then Keys' bicubic (a = -0.75), corners on corners."""
    n, factor = len(line), len(line) / size
    sigma = max((factor - 1) / 2, 0.001)
    taps = int(max(4 * sigma, 3))
    reach = (taps + 1 - taps % 2) // 2
    weights = [math.exp(-0.5 * (k / sigma) ** 2) for k in range(-reach, reach + 1)]

    def reflected(i):
        i = abs(i)
        return line[i if i < n else 2 * (n - 1) - i]

    blurred = [sum(w * reflected(i + k - reach) for k, w in enumerate(weights)) / sum(weights) for i in range(n)]

    def keys(x, a=-0.75):
        x = abs(x)
        if x <= 1:
            return (a + 2) * x**3 - (a + 3) * x**2 + 1
        return a * x**3 - 5 * a * x**2 + 8 * a * x - 4 * a if x < 2 else 0.0

    out = []
    for j in range(size):
        place = j * (n - 1) / (size - 1)
        base = math.floor(place)
        out.append(sum(keys(place - k) * blurred[min(max(k, 0), n - 1)] for k in range(base - 1, base + 3)))
    return out


@pytest.mark.parametrize("length", [24, 37, 100])
def test_resampling_is_the_plain_one_along_each_side(length):
    """An image that varies along one side only: the other side's resampling keeps it as it is."""
    line = torch.rand(length, generator=torch.Generator().manual_seed(length), dtype=torch.float64)
    expected = torch.tensor(_reference(line.tolist(), 24), dtype=torch.float64)
    wide = squashed(line.expand(1, 3, 24, length), 24)
    tall = squashed(line[:, None].expand(1, 3, length, 24), 24)
    if length > 24:  # the other axis then is blurred by nothing
        torch.testing.assert_close(wide[0, 1, 5], expected, rtol=0, atol=1e-12)
        torch.testing.assert_close(tall[0, 2, :, 7], expected, rtol=0, atol=1e-12)
    else:
        assert torch.equal(wide[0, 1, 5], line)


def test_enlarging_does_not_blur():
    image = torch.rand(1, 3, 16, 16, dtype=torch.float64)
    enlarged = squashed(image, 31)  # corners on corners: every second pixel is an old one
    torch.testing.assert_close(enlarged[:, :, ::2, ::2], image, rtol=0, atol=1e-12)


def test_embedding_is_not_of_unit_length_and_sees_the_borders():
    torch.manual_seed(0)
    tower = ClipImageTower(ClipConfig(64, 2, 128, 8, 32, 24, 1, quick_gelu=False))
    image = torch.rand(1, 3, 64, 128)
    raw = embed(tower, image)
    assert abs(float(raw.norm()) - 1) > 0.1
    changed = image.clone()
    changed[..., :8] = 0  # outside of the centre square
    assert float((embed(tower, changed) - raw).abs().max()) > 1e-3
    assert torch.equal(tower(changed), tower(image))
    unit = torch.nn.functional.normalize(tower.embed(normalized(squashed(image, 32))), dim=-1)
    torch.testing.assert_close(torch.nn.functional.normalize(raw, dim=-1), unit)


def test_context_is_the_mean_of_the_given_views():
    views = torch.arange(6.0).reshape(3, 2)
    assert torch.equal(context(views), torch.tensor([[2.0, 3.0]]))
    with pytest.raises(ValueError, match="at least one given view"):
        context(views[:0])
