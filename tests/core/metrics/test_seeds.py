"""Standard errors over seeds against closed forms, scipy and repeated draws."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from cat3d_core.metrics.seeds import Mean, difference, mean_over_seeds, t95


def test_one_scene_has_the_textbooks_standard_error() -> None:
    values = [20.0, 21.5, 20.4, 20.9, 19.8]
    found = mean_over_seeds({"a": values})
    assert found.value == pytest.approx(np.mean(values))
    assert found.error == pytest.approx(stats.sem(values))
    assert found.freedom == 4


def test_one_seed_a_scene_says_that_nothing_is_known() -> None:
    found = mean_over_seeds({"a": [20.0], "b": [30.0]})
    assert found == Mean(25.0, None, 0)
    assert found.certain is None
    assert difference(found, mean_over_seeds({"a": [1.0, 2.0]})).certain is None
    with pytest.raises(ValueError, match="needs a scene"):
        mean_over_seeds({})


def test_a_scene_with_one_seed_takes_the_pooled_variance() -> None:
    """By hand: s² = ((1)² + (1)²) / 1 = 2 of scene a; errors s²/2 and s²/1 add, over two scenes."""
    found = mean_over_seeds({"a": [19.0, 21.0], "b": [30.0]})
    assert (found.value, found.freedom) == (25.0, 1)
    assert found.error == pytest.approx(math.sqrt(2 / 2 + 2 / 1) / 2)


def test_the_error_is_the_deviation_of_repeated_sweeps() -> None:
    rng = np.random.default_rng(0)
    truth = {"a": 10.0, "b": 30.0, "c": 20.0}

    def sweep() -> Mean:
        return mean_over_seeds({name: rng.normal(value, 0.5, 4).tolist() for name, value in truth.items()})

    sweeps = [sweep() for _ in range(2000)]
    deviation = np.std([s.value for s in sweeps])
    assert np.sqrt(np.mean([s.error**2 for s in sweeps])) == pytest.approx(deviation, rel=0.05)  # type: ignore[operator]
    assert deviation == pytest.approx(0.5 / math.sqrt(12), rel=0.05)
    pairs = zip(sweeps[::2], sweeps[1::2], strict=True)
    wrong = np.mean([difference(a, b).certain for a, b in pairs])  # type: ignore[arg-type]
    assert wrong == pytest.approx(0.05, abs=0.025), "of equal sweeps one in twenty differs"


def test_a_difference_is_welchs() -> None:
    a, b = [1.0, 2.0, 4.0, 3.0], [2.0, 2.2, 2.1]
    found = difference(mean_over_seeds({"x": a}), mean_over_seeds({"x": b}))
    expected = stats.ttest_ind(a, b, equal_var=False)
    assert found.value / found.error == pytest.approx(expected.statistic)
    assert found.freedom == pytest.approx(expected.df)


@pytest.mark.parametrize("freedom", [1, 2, 3.7, 8, 11, 25, 59, 1000])
def test_quantiles_are_never_smaller_than_scipys(freedom: float) -> None:
    exact = stats.t.ppf(0.975, math.floor(freedom))
    assert exact - 5e-4 <= t95(freedom) <= 1.03 * exact


def test_below_one_degree_of_freedom_the_quantile_is_that_of_one() -> None:
    """Welch's degrees of freedom are never fewer, but for rounding."""
    assert t95(1 - 1e-12) == t95(1) == pytest.approx(stats.t.ppf(0.975, 1), abs=5e-4)


def test_infinite_and_equal_values() -> None:
    endless = mean_over_seeds({"a": [math.inf, math.inf]})
    assert endless == Mean(math.inf)
    assert difference(endless, endless).value == 0.0
    same = mean_over_seeds({"a": [5.0, 5.0]})
    assert difference(same, same).certain is False
    assert difference(same, mean_over_seeds({"a": [6.0, 6.0]})).certain is True
    assert mean_over_seeds({"a": [21.0, 22.0]}).text(2) == "21.50 ± 0.50"
