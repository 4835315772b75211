"""The periodogram of residuals along the scan, on scans and noise whose variances are known."""

from itertools import pairwise

import numpy as np
import pytest
from scipy import stats
from scipy.sparse import csr_matrix

from mcsim.reconstruction.periods import DRAWS, FEWEST, SPANS, TimeLine
from mcsim.reconstruction.scores import HISTORY, PERIODIC, Scene

SPAN_S, COUNT, PIXELS, EACH = 300.0, 4000, 500, 5
NOISE = 4.0  #: variance of the products of residuals


@pytest.fixture(scope="module")
def line():
    """A map whose pixels are met at random."""
    draw = np.random.default_rng(1)
    pixel, span = draw.integers(PIXELS, size=EACH * COUNT), np.repeat(np.arange(COUNT), EACH)
    hits = np.bincount(pixel, minlength=PIXELS)
    visits = csr_matrix((1.0 / hits[pixel], (span, pixel)), (COUNT, PIXELS))
    return TimeLine.of((visits,), SPAN_S, {"": [np.full(PIXELS, NOISE)]})


def wave(line, period_s, phase=0.3):
    """Return the mean of a wave over the samples of every pixel."""
    middle = SPAN_S * np.arange(COUNT)
    return line.visits[0].T @ np.cos(2.0 * np.pi * middle / period_s + phase)


def test_the_power_of_noise_is_that_of_its_variance(line):
    """Of one frequency the power over its mean is F with 2 and 2 DRAWS degrees of freedom, of noise in the products."""
    draw = np.random.default_rng(2)
    place = np.arange(100, 2000, 19)
    ratios = np.array([line.power([np.sqrt(NOISE) * draw.normal(size=PIXELS)])[place] for _ in range(40)])
    ratios = (ratios / line.variance[""][place]).ravel()
    assert stats.kstest(ratios, stats.f(2, 2 * DRAWS).cdf).statistic < 4.0 * np.sqrt(0.25 / len(ratios)) * 1.5


def test_noise_has_no_peak_beyond_the_number_of_frequencies(line):
    """The largest of n ratios is beyond a value with the probability of n: padding adds less than as much again."""
    draw = np.random.default_rng(3)
    falls = np.array([line.peak("", [np.sqrt(NOISE) * draw.normal(size=PIXELS)]).fall for _ in range(400)])
    level = 2.0 * stats.f(2, 2 * DRAWS).isf(0.1 / line.tried)
    share = np.mean(falls > level)
    assert 0.1 - 4.0 * np.sqrt(0.09 / 400) < share < 0.2 + 4.0 * np.sqrt(0.16 / 400)


@pytest.mark.parametrize("period_s", [SPANS * SPAN_S * 1.01, 5640.0, 86400.0, SPAN_S * COUNT / (FEWEST + 1)])
def test_a_wave_is_the_peak(line, period_s):
    """Its period is found within a quarter of a cycle in the survey; its fall is what its size in the maps makes."""
    mean = wave(line, period_s)
    snr = 12.0
    size = snr / np.sqrt(NOISE * mean @ mean)  # of a wave times the precision, NOISE
    falls = []
    for k in range(10):
        noise = np.sqrt(NOISE) * np.random.default_rng(10 + k).normal(size=PIXELS)
        peak = line.peak("", [NOISE * size * mean + noise])
        assert abs(1.0 / peak.numbers[0] - 1.0 / period_s) < 0.25 / line.duration_s
        assert peak.kind == f"period {peak.numbers[0]!r}"  # it is a part of the structure's kind, which is read again
        falls.append(peak.fall)
    # At best snr^2 + 2; between two frequencies (2 / pi)^2 of it is lost with as many as are independent, 0.19 here.
    error = 2.0 * snr / np.sqrt(10) + snr**2 * np.sqrt(1.0 / DRAWS) * 2.0
    assert 0.81 * snr**2 - 4.0 * error < np.mean(falls) < snr**2 + 2.0 + 4.0 * error


def test_the_wrong_variance_is_seen(line):
    """Twice the noise that the time line knows of has peaks twice as high."""
    draw = np.random.default_rng(4)
    noise = [np.sqrt(2.0 * NOISE) * draw.normal(size=PIXELS) for _ in range(100)]
    ratio = np.mean([line.power([one])[100:2000] / line.variance[""][100:2000] for one in noise])
    assert abs(ratio - 2.0) < 4.0 * 2.0 * np.sqrt(1.0 / 100 + 1.0 / DRAWS) / np.sqrt(PIXELS)


@pytest.mark.parametrize(("spans", "looked_for"), [(16, False), (18, True)])
def test_no_period_is_looked_for_in_a_survey_of_an_hour(spans, looked_for):
    """A period is told by FEWEST cycles of the shortest one, a quarter of an hour, and one more to choose among."""
    visits = csr_matrix(np.full((spans, 12), 1.0 / spans))
    line = TimeLine.of((visits,), SPAN_S, {on: [np.ones(12)] for on in PERIODIC})
    empty = np.zeros(0)
    scene = Scene(
        ("W",), (None,), ("",), (True,), "ecliptic", "ecliptic", 1, 2, np.zeros(3), empty, 1, (), (), False, (line,)
    )
    assert len(scene.continua) - 1 == 2 * looked_for
    assert np.isfinite(np.log([tried for _, tried in scene.continua])).all()


@pytest.mark.parametrize("spans", [1, 5, 16, 17, 500])
def test_every_span_is_in_one_part_of_a_history(spans):
    """A survey of fewer spans than parts has parts of which nothing is known."""
    product = np.random.default_rng(5).normal(size=spans)
    line = TimeLine((csr_matrix(np.eye(spans)),), SPAN_S, {})
    starts = np.array([k * spans // HISTORY for k in range(HISTORY)] + [spans])
    expected = [product[a:b].sum() for a, b in pairwise(starts)]
    np.testing.assert_allclose(line.history(0, product, HISTORY), expected, rtol=1e-12, atol=1e-12)
