"""P-values beyond the ranks of held-out simulations: the rate of small ones in fresh data."""

import numpy as np
import pytest
from scipy import stats

from mcsim.stats.look_elsewhere import Calibration, deviates_of_means

ENSEMBLES, COUNT, DATA, LEVEL = 300, 1000, 2000, 1e-3
RAREST = 1e-4


def heavy(rng: np.random.Generator, count: int) -> np.ndarray:
    """P-values whose rank is their square root: 30 times too many at 1e-6."""
    return rng.random(count) ** 2


def students(rng: np.random.Generator, count: int) -> np.ndarray:
    """The smallest p-value, times their number, of 20 Student t of ten degrees of freedom that are taken for normal."""
    largest = np.abs(rng.standard_t(10, size=(count, 20))).max(axis=1)
    return np.minimum(40.0 * stats.norm.sf(np.sqrt(0.8) * largest), 1.0)


def test_small_pvalues_of_gaussian_data_are_rarer_than_they_say() -> None:
    """An estimate of the power that is below one by chance counts, one above does not: with both 1.5 times the level.

    By the value of each ensemble that just has this p-value: the error of the mean of a thousand is 0.013 of the level.
    """
    rng, values, found = np.random.default_rng(28), np.geomspace(1e-15, 0.1, 5000), []
    for _ in range(1000):
        calibration = Calibration(1, np.empty(0), np.empty(0), np.sort(rng.random(COUNT)))
        found.append(values[np.searchsorted(calibration.global_pvalue(values), RAREST)])
    assert 0.5 * RAREST < np.mean(found) < RAREST


def test_small_pvalues_that_are_too_many_become_as_rare_as_they_say() -> None:
    assert 0.7 * LEVEL < rate(heavy, np.random.default_rng(28)) < 1.2 * LEVEL


@pytest.mark.slow
def test_small_pvalues_of_heavy_tails_are_rare() -> None:
    """In proportion to the p-value at the lowest ten ranks they were four times too many."""
    assert 0.6 * LEVEL < rate(students, np.random.default_rng(28)) < 1.5 * LEVEL


def rate(drawn, rng: np.random.Generator) -> float:
    """Return the share of p-values of data up to LEVEL, over ensembles of simulations."""
    found = []
    for _ in range(ENSEMBLES):
        calibration = Calibration(1, np.empty(0), np.empty(0), np.sort(drawn(rng, COUNT)))
        found.append(np.mean(calibration.global_pvalue(drawn(rng, DATA)) <= LEVEL))
    return float(np.mean(found))


@pytest.mark.parametrize("count", [2, 3, 20])
@pytest.mark.parametrize("complex_", [False, True])
def test_means_of_few_draws_over_their_errors_are_normal_deviates(count, complex_):
    """A mean of two is above twice its error in 30 % of cases; what is told of it is above two in 4.6 %."""
    rng, cases = np.random.default_rng(5), 20_000
    drawn = rng.normal(size=(cases, count)) + (1j * rng.normal(size=(cases, count)) if complex_ else 0.0)
    ratio = np.abs(drawn.mean(axis=1)) / drawn.std(axis=1, ddof=1) * np.sqrt(count)
    z = deviates_of_means(ratio, np.full(cases, complex_), count)
    for level in (1.0, 2.0, 3.0):
        expected = 2.0 * stats.norm.sf(level)
        assert abs(np.mean(z > level) - expected) < 4.0 * np.sqrt(expected / cases)
    far = deviates_of_means(np.array([30.0, 37.0, 38.0, 400.0]), np.full(4, complex_), 1000)
    assert np.all(np.diff(far) > 0.0)
    assert np.isfinite(far).all()
    assert deviates_of_means(np.array([3.0]), np.array([complex_]), 1) == 0.0
