from dataclasses import replace
from pathlib import Path

import healpy
import numpy as np
import pytest

from mcsim.instrument.scan import Moments, ScanModel
from mcsim.instrument.scan.factors import latitude_means, limit_factors, ring_means, scan_factors, sky_means, summary
from mcsim.instrument.scan.limit import limit_moments
from mcsim.plot.scan import scan_figure
from refusals import refused

WMAP = ScanModel.load(Path(__file__).parents[2] / "scan_models" / "wmap.toml")
NSIDE = 64
THETA = healpy.pix2ang(NSIDE, np.arange(12 * NSIDE**2))[0]


@pytest.fixture(scope="module")
def year():
    """One year sampled every 2 s: 321 samples per pixel of nside 64."""
    return Moments.from_model(WMAP.with_sampling(2.0), NSIDE, 2, nthreads=2)


def made_up(w2):
    return Moments(NSIDE, "ecliptic", np.ones(w2.size), np.array([0.0 * w2, w2], dtype=complex))


def test_parallel_transport_has_factors_of_one():
    factors = scan_factors(Moments.parallel_transport(NSIDE, 0.0, 2), (2, 50, 300))
    assert factors.quadrupole_ratio == pytest.approx(1.0, abs=1e-14)
    assert factors.sky_mean == pytest.approx(1.0, abs=1e-14)
    # (2l+1)/2 int (d^l_22)^2 dcos(theta) = 1.
    np.testing.assert_allclose(factors.f_ell, 1.0, atol=1e-12)


def test_what_was_not_observed_changes_no_factor_of_parallel_transport():
    moments = Moments.parallel_transport(32)
    x, _, z = healpy.pix2vec(32, np.arange(moments.npix))
    seen = (z < 0.5) & (x < 0.3)  # a cap is missing, and part of every other ring
    found = scan_factors(replace(moments, hits=seen.astype(float), w=np.where(seen, moments.w, 0.0)))
    assert [found.quadrupole_ratio, found.sky_mean] == pytest.approx([1.0, 1.0], rel=1e-12)
    np.testing.assert_allclose(found.f_ell, 1.0, rtol=1e-12)


def test_factors_of_a_known_pattern():
    # w_2 = cos^2(theta): int z^2 (1-z^2) / int (1-z^2) = 1/5, sky mean 1/3, and z^2 = (1 + 2 P_2)/3 with
    # (2l+1)/2 int (d^l_22)^2 P_2 dz = <l2;20|l2>^2 = (3*4 - l(l+1))^2 / (l(l+1)(2l-1)(2l+3)).
    ell = np.array([2, 3, 10, 100])
    factors = scan_factors(made_up(np.cos(THETA) ** 2), ell)
    assert factors.quadrupole_ratio == pytest.approx(0.2, abs=1e-3)
    assert factors.sky_mean == pytest.approx(1.0 / 3.0, abs=1e-3)
    mean_p2 = (12.0 - ell * (ell + 1.0)) ** 2 / (ell * (ell + 1.0) * (2 * ell - 1.0) * (2 * ell + 3.0))
    # Linear interpolation between rings 0.7 degrees apart, and pixel sums.
    np.testing.assert_allclose(factors.f_ell, (1.0 + 2.0 * mean_p2) / 3.0, atol=1e-3)


def test_one_year_of_wmap_against_limit_and_reference(year):
    streamed, limit = scan_factors(year), limit_factors(WMAP)
    # DESIGN.md: 0.6575 and 0.555 within 0.002; f_l 0.4607, 0.4606, 0.4604 at l = 100, 200, 400 within 0.005.
    for factors in (streamed, limit):
        assert factors.quadrupole_ratio == pytest.approx(0.6575, abs=0.002)
        assert factors.sky_mean == pytest.approx(0.5550, abs=0.002)
        np.testing.assert_allclose(factors.f_ell, [0.4724, 0.4607, 0.4606, 0.4604], atol=0.005)
    assert sky_means(year)[1].real == pytest.approx(streamed.sky_mean, abs=1e-15)


# |latitude| bins of 10 degrees, an independent simulation of one year at nside 256.
REFERENCE_W2 = [0.8267, 0.7956, 0.7219, 0.5707, 0.1761, 0.1689, 0.2987, 0.3707, 0.3244]


def test_w2_by_latitude_is_the_reference(year):
    hits, w = latitude_means(year)
    # Pixels of 0.9 degrees straddle the edges of the bins, where w_2 is steep and at the caustics (48, 87 degrees).
    np.testing.assert_allclose(w[1].real, REFERENCE_W2, atol=0.01)
    # Fewest hits at the equator, most at the poles and at 48 degrees.
    assert np.argmin(hits) == 0
    assert np.argmax(hits) == 8
    assert hits[4] > hits[3] > hits[2]


@pytest.mark.slow
def test_limit_by_latitude_is_the_reference():
    # Midpoints in cos(theta), at most 0.6 degrees apart at the pole.
    z = (np.arange(20_000) + 0.5) / 20_000
    w2 = limit_moments(WMAP, np.arccos(z), 2)[1][1].real
    which = np.digitize(np.degrees(np.arcsin(z)), range(10, 90, 10))
    means = np.bincount(which, weights=w2) / np.bincount(which)
    np.testing.assert_allclose(means, REFERENCE_W2, atol=0.005)


def test_ring_and_latitude_means_of_single_pixels():
    hits, w2 = np.zeros(THETA.size), np.zeros(THETA.size)
    equator = THETA.size // 2
    hits[[0, 1, equator]], w2[[0, 1, equator]] = [2.0, 4.0, 6.0], [0.5, -0.25, 0.75]
    moments = Moments(NSIDE, "ecliptic", hits, np.array([w2, w2], dtype=complex))
    theta, ring_hits, w = ring_means(moments)
    np.testing.assert_allclose(theta, np.unique(THETA.round(12)), atol=1e-11)
    assert w[0, 0] == 0.125
    assert ring_hits[0] == pytest.approx(1.5 / hits.mean())
    assert w[0, 2 * NSIDE - 1] == 0.75
    assert not w[0, 1 : 2 * NSIDE - 1].any()
    band_hits, band_w = latitude_means(moments, (0, 10, 80, 90))
    np.testing.assert_array_equal(np.isnan(band_w[0]), [False, True, False])
    np.testing.assert_allclose(band_w[0, [0, 2]], [0.75, 0.125])
    assert band_hits[1] == 0.0
    assert scan_factors(moments, [2]).sky_mean == pytest.approx(1.0 / 3.0)


def test_hits_by_latitude_are_over_the_mean_of_the_whole_sky():
    """Where one half of the sky is seen: over the mean of that half they would be 0.5."""
    north = np.cos(THETA) > 0.0
    moments = Moments(NSIDE, "ecliptic", north.astype(float), np.zeros((2, THETA.size), dtype=complex))
    hits, _ = latitude_means(moments, (0, 45, 90))
    np.testing.assert_allclose(hits, 1.0, atol=0.03)  # the equator's pixels count as the south's


def test_summary_says_what_each_number_is(year):
    text = summary("WMAP", year)
    assert "nside 64, ecliptic frame, 1.57788e+07 samples" in text
    assert "unobserved: 0.0000% of the sky" in text
    for words in ("w_2 = 0.55", "0-10: 0.827", "BipoSH L = 2, M = 0", "least squares", "f_l = 0.47", "the paper's"):
        assert words in text
    assert len(summary("one", Moments(year.nside, year.frame, year.hits, year.w[:1])).splitlines()) == 3


def test_what_cannot_be_answered_is_refused(year):
    short = Moments(year.nside, year.frame, year.hits, year.w[:1])
    for function in (scan_factors, scan_figure):
        with refused("s = 1", "s = 2", "smax"):
            function(short)
    with refused("f_l", "l = 1", "l >= 2"):
        scan_factors(year, (1, 2))
    with refused("hits"):
        sky_means(Moments(1, "ecliptic", np.zeros(12), np.zeros((1, 12), dtype=complex)))


def test_figure_draws_the_maps(year, tmp_path):
    hits = year.hits.copy()
    hits[:50] = 0.0
    figure = scan_figure(Moments(year.nside, year.frame, hits, year.w), "one year", WMAP)
    figure.savefig(tmp_path / "scan.png", dpi=40)
    images = [axes.images[0].get_array() for axes in figure.axes if axes.images]
    assert len(images) == 2
    # The middle of the map is longitude 0, latitude 0; rows grow northwards.
    rows, columns = images[1].shape
    middle = healpy.vec2pix(NSIDE, 1.0, 0.0, 0.0)
    assert images[1][rows // 2, columns // 2] == pytest.approx(year.w[1, middle].real, abs=0.05)
    assert images[1].mask[rows - 3, columns // 2]
    assert not images[1].mask[3, columns // 2]
    lines = figure.axes[2].get_lines() + figure.axes[3].get_lines()
    assert len(lines) == 5
