"""Histograms: sampling, blur, distortion, against direct float64 formulas."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from cat3d_core.zipnerf import stepfun


def _histogram(
    rows: int, bins: int, seed: int = 0, dtype: torch.dtype = torch.float64
) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    t = torch.rand((rows, bins + 1), generator=generator, dtype=dtype).sort(-1).values
    w = torch.rand((rows, bins), generator=generator, dtype=dtype) ** 8
    return t, w / w.sum(-1, keepdim=True).clamp_min(1e-9)


def test_density_integrates_to_the_weight_and_ignores_empty_bins() -> None:
    t = torch.tensor([0.0, 0.25, 0.25, 1.0])
    w = torch.tensor([0.5, 0.3, 0.2])
    p = stepfun.pdf_from_weights(t, w)
    assert p[1] == 0
    torch.testing.assert_close(p * t.diff(), torch.tensor([0.5, 0.0, 0.2]))


def test_samples_follow_the_distribution() -> None:
    t, w = _histogram(1, 12)
    u = torch.linspace(0, 1 - 1e-9, 200_001, dtype=torch.float64)[None]
    samples = stepfun.invert_cdf(u, t, w.log())
    counts = torch.histogram(samples[0], t[0]).hist / u.numel()
    torch.testing.assert_close(counts, w[0], rtol=0, atol=2e-5)


@settings(deadline=None, max_examples=50)
@given(st.integers(0, 10_000), st.integers(2, 40), st.integers(2, 40), st.booleans())
def test_intervals_are_ordered_inside_and_finite(seed: int, bins: int, count: int, jitter: bool) -> None:
    t, w = _histogram(3, bins, seed, torch.float32)
    t[:, 0], t[:, -1] = 0, 1
    t[0, 1:-1] = 0.5  # ties: all inner bins without width
    w[1] = 0  # a ray without any weight
    logits = w.clamp_min(torch.finfo(torch.float32).tiny).log()
    generator = torch.Generator().manual_seed(seed) if jitter else None
    edges = stepfun.sample_intervals(t, logits, count, generator)
    assert edges.shape == (3, count + 1)
    assert torch.isfinite(edges).all()
    assert (edges.diff() >= -1e-6).all()
    assert (edges >= 0).all()
    assert (edges <= 1).all()


def _blurred_reference(
    query: torch.Tensor, t: torch.Tensor, w: torch.Tensor, h: float, steps: int = 20_000
) -> torch.Tensor:
    """The blurred density on a dense midpoint grid, each value a sum of box overlaps."""
    p = w / t.diff()
    x = (torch.arange(steps, dtype=torch.float64) + 0.5) / steps
    overlap = torch.minimum(x[:, None] + h, t[1:]) - torch.maximum(x[:, None] - h, t[:-1])
    density = (overlap.clamp_min(0) * p).sum(-1) / (2 * h)
    return torch.stack(
        [(density * ((x >= a) & (x < b))).sum() / steps for a, b in zip(query[:-1], query[1:], strict=True)]
    )


@pytest.mark.parametrize("halfwidth", [0.03, 0.003])
def test_blur_matches_a_direct_convolution(halfwidth: float) -> None:
    t, w = _histogram(1, 8)
    query = torch.linspace(0, 1, 17, dtype=torch.float64)
    got = stepfun.blurred_resample(query[None], t, w, halfwidth)[0]
    torch.testing.assert_close(got, _blurred_reference(query, t[0], w[0], halfwidth), rtol=0, atol=2e-4)


@pytest.mark.parametrize("halfwidth", [0.03, 0.003])
def test_blur_keeps_the_weight_and_is_exact_in_float32(halfwidth: float) -> None:
    t, w = _histogram(64, 32)
    t = 0.1 + 0.8 * t
    t[:, 5] = t[:, 6]
    w[:, 5] = 0
    query = torch.linspace(0, 1, 65, dtype=torch.float64).expand(64, 65)
    got = stepfun.blurred_resample(query, t, w, halfwidth)
    torch.testing.assert_close(got.sum(-1), w.sum(-1), rtol=0, atol=1e-12)
    single = stepfun.blurred_resample(query.float(), t.float(), w.float(), halfwidth)
    exact = stepfun.blurred_resample(query.float().double(), t.float().double(), w.float().double(), halfwidth)
    torch.testing.assert_close(single.double(), exact, rtol=1e-6, atol=1e-9)
    assert (single >= 0).all()


def test_distortion_matches_the_double_sum() -> None:
    t, w = _histogram(20, 32)
    m = 0.5 * (t[:, 1:] + t[:, :-1])
    pairs = (w[:, :, None] * w[:, None] * (m[:, :, None] - m[:, None]).abs()).sum((1, 2))
    expected = pairs + (w.square() * t.diff()).sum(-1) / 3
    torch.testing.assert_close(stepfun.distortion(t, w), expected, rtol=1e-12, atol=0)
    torch.testing.assert_close(stepfun.distortion(t.float(), w.float()).double(), expected, rtol=5e-5, atol=0)
    w = w.requires_grad_()
    assert torch.autograd.gradcheck(lambda weights: stepfun.distortion(t, weights), (w,))
    assert (stepfun.distortion(t, w) >= 0).all()


def test_median_of_surfaces_and_of_nothing() -> None:
    t = torch.tensor([[0.0, 1.0, 2.0, 3.0]]).expand(3, 4)
    w = torch.tensor([[0.0, 1.0, 0.0], [0.5, 0.0, 0.5], [0.0, 0.0, 0.0]])
    assert stepfun.quantile(t, w, 0.5).tolist() == pytest.approx([1.5, 2.0, 3.0])


def test_distortion_of_thin_bins_far_from_the_origin() -> None:
    """Found by `cat3d stress`: gaps of middles, taken as differences of the middles, were off by 3e-3 in float32."""
    t = torch.tensor([[0.0, 5.31951780e-04, 5.31951780e-04, 5.31955331e-04]])
    w = torch.tensor([[0.0, 0.33191338, 0.43552593]])
    exact = stepfun.distortion(t.double(), w.double())
    torch.testing.assert_close(stepfun.distortion(t, w).double(), exact, rtol=1e-6, atol=0)


def test_quantiles_are_where_the_running_sum_gets_there() -> None:
    """Against a loop over edges in float64, with more batch axes than one."""
    t, w = _histogram(6, 9, seed=4)
    found = stepfun.quantile(t.view(2, 3, 10), w.view(2, 3, 9), 0.3).flatten()
    for row in range(6):
        aim, bin_, below = 0.3 * float(w[row].sum()), 0, 0.0
        while below + float(w[row, bin_]) < aim:
            below += float(w[row, bin_])
            bin_ += 1
        share = (aim - below) / float(w[row, bin_])
        assert float(found[row]) == pytest.approx(float(t[row, bin_] + share * (t[row, bin_ + 1] - t[row, bin_])))
