"""Means over seeds with their standard error, and whether a difference of two is more than noise.

One place for all tables and comparisons. A seed changes the result of one scene by tenths of a dB (up to one), so a
difference between two methods or two versions counts only against how far seeds alone move the means.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

#: Two-sided 95 % quantiles of Student's t distribution, by degrees of freedom; between them the larger one is taken.
_T95 = {1: 12.706, 2: 4.303, 3: 3.182, 4: 2.776, 5: 2.571, 6: 2.447, 7: 2.365, 8: 2.306, 9: 2.262, 10: 2.228,
        12: 2.179, 15: 2.131, 20: 2.086, 30: 2.042, 60: 2.000, 120: 1.980}  # fmt: skip


@dataclass(frozen=True)
class Mean:
    """A mean over scenes, and the standard error that it has because other seeds would give another one.

    error: in the unit of `value`; None where no scene has two seeds, so that nothing is known of it.
    freedom: degrees of freedom that the error is estimated with, 0 where it is None.
    """

    value: float
    error: float | None = None
    freedom: float = 0.0

    @property
    def certain(self) -> bool | None:
        """Whether the value differs from zero by more than seeds explain (95 %); None where that is not known."""
        if self.error is None:
            return None
        return abs(self.value) > t95(self.freedom) * self.error

    def text(self, digits: int, signed: bool = False) -> str:
        """Such as "21.34 ± 0.12", or the value alone where its error is not known. signed: a plus before a gain."""
        plain = "+" * (signed and self.value > 0) + f"{self.value:.{digits}f}"
        return plain if self.error is None else f"{plain} ± {self.error:.{digits}f}"


def mean_over_seeds(scenes: Mapping[str, Sequence[float]]) -> Mean:
    """The mean over scenes of each scene's mean over its seeds.

    scenes: for each of S scenes its values, one a seed, n_s of them. The variance between seeds s² is pooled over the
    scenes, with sum(n_s - 1) degrees of freedom; the mean's standard error is then sqrt(s² sum(1 / n_s)) / S. Scenes
    are not drawn at random here: all that is compared is measured on the same ones, so their differences are no noise.
    Raises ValueError without any value.
    """
    if not scenes or not all(scenes.values()):
        raise ValueError("A mean needs a scene, and each scene a value.")
    means = {name: math.fsum(values) / len(values) for name, values in scenes.items()}
    value = math.fsum(means.values()) / len(means)
    freedom = sum(len(values) - 1 for values in scenes.values())
    if not freedom or not math.isfinite(value):
        return Mean(value)
    squares = math.fsum((v - means[name]) ** 2 for name, values in scenes.items() for v in values)
    error = math.sqrt(squares / freedom * math.fsum(1 / len(values) for values in scenes.values())) / len(scenes)
    return Mean(value, error, freedom)


def difference(first: Mean, second: Mean) -> Mean:
    """first - second, with the standard error and degrees of freedom of Welch's t-test (Welch 1947)."""
    value = 0.0 if first.value == second.value else first.value - second.value  # two infinite PSNR are equal
    if first.error is None or second.error is None or not math.isfinite(value):
        return Mean(value)
    parts = [(m.error or 0.0) ** 2 for m in (first, second)]
    total = sum(parts)
    if not total:
        return Mean(value, 0.0, first.freedom + second.freedom)
    shares = sum((part / total) ** 2 / m.freedom for part, m in zip(parts, (first, second), strict=True))
    return Mean(value, math.sqrt(total), 1 / shares)


def t95(freedom: float) -> float:
    """The two-sided 95 % quantile of Student's t distribution, rounded up to that of the next smaller entry."""
    known = [quantile for entry, quantile in _T95.items() if entry <= freedom]
    return known[-1] if known else _T95[1]
