"""Compact sources in residuals, where the beam, the noise and the source are known."""

import healpy
import numpy as np
import pytest
from scipy import stats

from mcsim.reconstruction import sources
from mcsim.reconstruction.choices import Choice, angle_apart, frequency_apart
from mcsim.sphere import alm as alm_
from mcsim.sphere import healpix

NSIDE, LMAX, SIGMA = 32, 95, np.deg2rad(3.0)
ELL = np.arange(LMAX + 1.0)
BEAM = np.exp(-0.5 * ELL * (ELL + 1.0) * SIGMA**2)
PRECISION = 1.0 + 0.8 * healpy.pix2vec(NSIDE, np.arange(12 * NSIDE**2))[2]


def scored(residual):
    """Return the scores of sources in every pixel."""
    seen = alm_.multiply(healpix.adjoint(residual, LMAX), BEAM, LMAX)
    return healpix.synthesis(seen[None], NSIDE, LMAX)[0]


def white(seed):
    """Return noise over its variance."""
    return np.sqrt(PRECISION) * np.random.default_rng(seed).normal(size=PRECISION.size)


def profile(place):
    """Return the map of a source of unit flux, for a Gaussian beam (of small angles)."""
    n = healpy.ang2vec(*place, lonlat=True) @ np.stack(healpy.pix2vec(NSIDE, np.arange(12 * NSIDE**2)))
    return np.exp(-0.5 * (np.arccos(np.clip(n, -1.0, 1.0)) / SIGMA) ** 2) / (2.0 * np.pi * SIGMA**2)


def test_a_source_adds_the_beam_about_its_place():
    place = (213.0, -41.0)
    seen = alm_.multiply(sources.at(place, LMAX), BEAM, LMAX)
    found, expected = healpix.synthesis(seen[None], NSIDE, LMAX)[0], profile(place)
    # e^(-l (l + 1) sigma^2 / 2) is a Gaussian in angle up to terms of sigma^2, 0.27 %.
    np.testing.assert_allclose(found, expected, atol=0.003 * expected.max())


@pytest.mark.parametrize("pixel", [100, 6144, 12000])
def test_the_variance_of_a_score_is_the_sum_over_pixels(pixel):
    own = profile(healpy.pix2ang(NSIDE, pixel, lonlat=True))
    found = sources.variance(PRECISION, BEAM, NSIDE, LMAX)[pixel]
    assert found == pytest.approx(PRECISION @ own**2, rel=0.01)


def test_the_variance_of_simulations_is_found_where_it_differs():
    """Scores with twice the variance of noise in one hemisphere, by 40 simulations of smooth maps: 10 %."""
    noise = sources.variance(PRECISION, BEAM, NSIDE, LMAX)
    factor = np.where(np.arange(noise.size) < noise.size // 2, 2.0, 1.0)
    drawn = [np.sqrt(factor) * scored(white(k)) for k in range(40)]
    found = sources.simulated_variance(noise, drawn) / noise / factor
    assert abs(np.mean(found) - 1.0) < 0.02
    assert np.std(found) < 0.3


def test_what_is_not_observed_has_no_source():
    half = np.where(np.arange(PRECISION.size) < PRECISION.size // 2, PRECISION, 0.0)
    variance = sources.variance(half, BEAM, NSIDE, LMAX)
    assert np.all(np.isinf(variance[PRECISION.size // 2 :]))
    assert np.mean(np.isfinite(variance[: PRECISION.size // 2])) > 0.95


def test_a_source_is_the_brightest():
    place = (40.0, 10.0)
    variance, own = sources.variance(PRECISION, BEAM, NSIDE, LMAX), profile(place)
    snr, falls = 10.0, []
    for seed in range(10):
        added = PRECISION * own * snr / np.sqrt(PRECISION @ own**2)
        found = sources.brightest(scored(white(seed) + added), variance)
        assert angle_apart(found, Choice("source 40.0 10.0", 0.0)) < 3.0 * SIGMA / snr + healpy.nside2resol(NSIDE)
        falls.append(found.fall)
    assert np.mean(falls) == pytest.approx(snr**2 + 2.0, abs=4.0 * 2.0 * snr / np.sqrt(10) + 0.05 * snr**2)


def test_the_fall_in_noise_is_chi_squared_of_one():
    """Of one place the fall has one degree of freedom; of two maps scores and their variances add."""
    variance = sources.variance(PRECISION, BEAM, NSIDE, LMAX)
    places = np.arange(0, PRECISION.size, 601)
    drawn = [(scored(white(k)) + scored(white(1000 + k)))[places] ** 2 / (2.0 * variance[places]) for k in range(50)]
    falls = np.concatenate(drawn)
    assert stats.kstest(falls, stats.chi2(1).cdf).pvalue > 1e-4


def test_choices_are_apart():
    assert angle_apart(Choice("source 0.0 0.0", 1.0), Choice("source 90.0 0.0", 1.0)) == pytest.approx(np.pi / 2)
    assert angle_apart(Choice("source 10.0 60.0", 1.0), Choice("source 190.0 60.0", 1.0)) == pytest.approx(np.pi / 3)
    assert frequency_apart(Choice("period 10.0", 1.0), Choice("period 20.0", 1.0)) == pytest.approx(0.05)
