"""Step functions on a line: histograms of weight along rays, their sampling, blur and distortion.

`t` (..., n+1) are non-decreasing edges, `w` (..., n) the non-negative weight of each bin, `p` = w / width its density.
"""

from __future__ import annotations

import torch
from torch import Tensor


def pdf_from_weights(t: Tensor, w: Tensor) -> Tensor:
    """Density of each bin; 0 where the bin has no width."""
    width = t[..., 1:] - t[..., :-1]
    positive = width > torch.finfo(t.dtype).tiny
    return torch.where(positive, w / torch.where(positive, width, 1.0), 0.0)


def _cumulative(w: Tensor) -> Tensor:
    zero = torch.zeros_like(w[..., :1])
    return torch.cat([zero, w.cumsum(-1)], -1)


def _locate(knots: Tensor, query: Tensor) -> tuple[Tensor, Tensor]:
    """Bin index of each query (last knot not above it) and offset in [0, 1] in that bin; 0 where the bin has no
    width."""
    index = torch.searchsorted(knots, query.contiguous(), right=True).sub_(1).clamp_(0, knots.shape[-1] - 2)
    low = knots.gather(-1, index)
    width = knots.gather(-1, index + 1) - low
    tiny = torch.finfo(knots.dtype).eps ** 2
    return index, ((query - low) / width.clamp_min(tiny)).clamp_(0.0, 1.0)


def invert_cdf(u: Tensor, t: Tensor, logits: Tensor) -> Tensor:
    """Positions (..., m) at which the distribution softmax(logits) over bins t reaches u (..., m) in [0, 1).

    Bins without width must carry logit -inf; at least one logit of a row must be finite.
    """
    cdf = _cumulative(torch.softmax(logits, -1)).clamp_max_(1.0)
    cdf[..., -1] = 1.0
    index, offset = _locate(cdf, u)
    low = t.gather(-1, index)
    return low + offset * (t.gather(-1, index + 1) - low)


def sample_intervals(t: Tensor, logits: Tensor, count: int, generator: torch.Generator | None = None) -> Tensor:
    """Edges (..., count+1) in [0, 1] of intervals around `count` samples of softmax(logits) (mip-NeRF 360 sec. 3,
    camp).

    With a generator all samples of a row share one uniform jitter (stratified); without they sit at bin centres.
    Interval ends are the midpoints between samples, the first and last reflected.
    """
    u = stratified(t, count, generator).expand(*t.shape[:-1], count)
    logits = torch.where(t[..., 1:] > t[..., :-1], logits, -torch.inf)
    centre = invert_cdf(u, t, logits)
    middle = 0.5 * (centre[..., 1:] + centre[..., :-1])
    first = (2.0 * centre[..., :1] - middle[..., :1]).clamp_min(0.0)
    final = (2.0 * centre[..., -1:] - middle[..., -1:]).clamp_max(1.0)
    return torch.cat([first, middle, final], -1)


def stratified(t: Tensor, count: int, generator: torch.Generator | None) -> Tensor:
    """Numbers (..., count) in [0, 1), evenly apart, for the rows of t (..., n+1): moved by one jitter a row; without a
    generator (count), at the middles of `count` bins."""
    eps = torch.finfo(t.dtype).eps
    if generator is None:
        pad = 0.5 / count
        return torch.linspace(pad, 1.0 - pad - eps, count, dtype=t.dtype, device=t.device)
    last = eps + (1.0 - eps) / count  # u never reaches 1
    jitter = torch.rand((*t.shape[:-1], 1), generator=generator, dtype=t.dtype, device=t.device)
    step = (1.0 - last) / max(count - 1, 1)
    return torch.linspace(0.0, 1.0 - last, count, dtype=t.dtype, device=t.device) + jitter * max(step - eps, 0.0)


def blurred_resample(query: Tensor, t: Tensor, w: Tensor, halfwidth: float) -> Tensor:
    """Weight (..., m) in the bins of `query` (..., m+1) of the histogram (t, w) convolved with a box of 2 * halfwidth.

    Zip-NeRF's spline inter-level target: the blurred histogram is piecewise linear, its integral F piecewise
    quadratic. With G(x) the integral of the cumulative weight, F(x) = (G(x + h) - G(x - h)) / 2h, which needs one
    search per end and no sort. The difference cancels in float32 (1e-5 of the total), so it is evaluated in float64;
    no gradient is wanted.
    """
    with torch.no_grad():
        t64, w64, query64 = t.double(), w.double(), query.double()
        cumulative = _cumulative(w64)
        width = t64[..., 1:] - t64[..., :-1]
        area = _cumulative(0.5 * (cumulative[..., 1:] + cumulative[..., :-1]) * width)

        def integral(x: Tensor) -> Tensor:
            index, offset = _locate(t64, x)
            bin_width = width.gather(-1, index)
            inside = offset * bin_width * (cumulative.gather(-1, index) + 0.5 * offset * w64.gather(-1, index))
            beyond = (x - t64[..., -1:]).clamp_min(0.0) * cumulative[..., -1:]
            return area.gather(-1, index) + inside + beyond

        mass = (integral(query64 + halfwidth) - integral(query64 - halfwidth)) / (2.0 * halfwidth)
        return (mass[..., 1:] - mass[..., :-1]).clamp_min(0.0).to(w.dtype)


def distortion(t: Tensor, w: Tensor) -> Tensor:
    """Distortion (...) of histograms: sum_ij w_i w_j |m_i - m_j| + 1/3 sum_i w_i^2 width_i (mip-NeRF 360 eq. 15), in
    O(n).

    The double sum is written as 2 sum_k (m_{k+1} - m_k) W_k (W - W_k), W_k the weight up to bin k: every term is
    positive, so nothing cancels and the result is never negative.
    """
    width = t[..., 1:] - t[..., :-1]
    # The gap of two middles from the widths: a difference of middles would lose thin bins far from the origin.
    gap = 0.5 * (width[..., 1:] + width[..., :-1])
    below = w.cumsum(-1)[..., :-1]
    above = w.flip(-1).cumsum(-1).flip(-1)[..., 1:]
    return 2.0 * (gap * below * above).sum(-1) + (w.square() * width).sum(-1) / 3.0


def quantile(t: Tensor, w: Tensor, fraction: float) -> Tensor:
    """Position (...) where the cumulative weight reaches `fraction` of its total; rows without weight give the last
    edge."""
    cumulative = _cumulative(w)
    total = cumulative[..., -1:]
    index, offset = _locate(cumulative, fraction * total)
    low = t.gather(-1, index)
    value = low + offset * (t.gather(-1, index + 1) - low)
    return torch.where(total > 0, value, t[..., -1:])[..., 0]
