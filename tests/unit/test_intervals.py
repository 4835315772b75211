"""Shares, means, widths and ratios with 95 % intervals, against their distributions."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from mcsim.stats import intervals


@given(st.integers(1, 300).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n))))
def test_binomial_intervals_are_those_of_the_beta_distribution(counts):
    k, n = counts
    low, high = intervals.binomial_interval(k, n)
    assert low == pytest.approx(stats.beta.ppf(0.025, k, n - k + 1) if k else 0.0, abs=1e-9)
    assert high == pytest.approx(stats.beta.ppf(0.975, k + 1, n - k) if k < n else 1.0, abs=1e-9)


def test_too_few_cases_meet_no_target():
    for metric in (intervals.share("x", []), intervals.mean("x", [1.0]), intervals.width("x", [1.0, 2.0])):
        assert np.isnan(metric.value)
        assert metric.within("above 0", 0.0).met is None
    assert intervals.removed("x", []).count == 0
    assert intervals.share("x", [True] * 19 + [False]).within("", 0.95).met is True
    assert intervals.share("x", [True] * 18 + [False]).within("", 0.95).met is False


def test_the_mean_of_two_values_has_no_interval():
    """Student's is 13 standard deviations wide, and says nothing."""
    two, three = intervals.mean("x", [0.5, 1.5]), intervals.mean("x", [0.5, 1.0, 1.5])
    assert (two.value, two.count) == (1.0, 2)
    assert np.isnan([two.low, two.high]).all()
    assert three.low < 1.0 < three.high


def test_a_value_is_near_a_target_that_its_interval_reaches():
    few, many = (intervals.share("x", [True] * 9 * n + [False] * n).within("", 0.95) for n in (2, 200))
    assert [(one.met, one.near) for one in (few, many)] == [(False, True), (False, False)]
    above = intervals.share("x", [True, *[False] * 99]).within("", high=0.05)
    assert (above.met, above.near) == (True, False)
    assert not intervals.share("x", []).within("", 0.95).near


def test_ratios_are_those_of_the_sums():
    gone = intervals.removed("x", [(10.0, 1.0), (20.0, 2.0), (1e-9, 3.0)])
    assert gone.value == pytest.approx(0.8)
    rng = np.random.default_rng(0)
    x = rng.uniform(20, 100, 400)
    delta_chi2 = [0.9 * x, x] + 15 * rng.standard_normal((2, 400))
    # The sums' errors, 15 sqrt(400) of some 24,000 each, are 1.8 % together.
    found = intervals.ratio("x", delta_chi2[1], delta_chi2[0])
    assert found.value == pytest.approx(0.9, abs=4 * 0.018 * 0.9)
    assert found.low < found.value < found.high


def test_intervals_cover_what_they_say():
    """Of 200 samples each interval holds the truth in 95 %; bootstrap of 60 cases: 93 % at least; 4 sigma."""
    rng = np.random.default_rng(5)
    hits = np.zeros(3)
    for _ in range(200):
        x = rng.standard_normal(60)
        found = intervals.mean("", x), intervals.width("", x), intervals.ratio("", 5 + x, 4 + rng.standard_normal(60))
        hits += [one.low < true < one.high for one, true in zip(found, (0.0, 1.0, 0.8), strict=True)]
    assert np.all(hits >= stats.binom.ppf(stats.norm.cdf(-4), 200, [0.95, 0.90, 0.93]))
    assert np.all(hits <= 199.5)


@pytest.mark.slow
def test_the_snr_at_a_power_is_that_of_the_probit():
    rng = np.random.default_rng(0)
    s = rng.uniform(1, 8, 3000)
    found = intervals.snr_at_power("", s, rng.random(3000) < stats.norm.cdf(s - 3.0), 2.0)
    truth = (3.0 + stats.norm.ppf(0.9)) / 2.0
    assert found.low < truth < found.high
    assert found.value == pytest.approx(truth, abs=0.1)
    assert np.isnan(intervals.snr_at_power("", s, s > 0).value)
    # Of one in twenty, a third of the resampled cases have none.
    few = intervals.snr_at_power("", s[:20], s[:20] == s[:20].max())
    assert few.low <= few.high
    assert np.isfinite([few.value, few.low, few.high]).all()


def test_the_interval_of_what_is_removed_holds_it():
    """The ends of the interval of a ratio change places where the ratio is taken from one."""
    rng = np.random.default_rng(0)
    found = intervals.removed("x", np.stack([rng.uniform(5, 9, 50), rng.uniform(1, 3, 50)], axis=1))
    assert found.low < found.value < found.high


def test_nineteen_cases_tell_no_snr():
    strengths = np.linspace(1.0, 9.0, 19)
    assert np.isnan(intervals.snr_at_power("x", strengths, strengths > 5.0).value)
