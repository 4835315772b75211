"""The prediction against a convolution done point by point with three-dimensional geometry."""

from math import comb, factorial, pi
from typing import NamedTuple

import numpy as np
import pytest
from scipy.special import sph_harm_y
from wignernj import wigner3j

from mcsim.bipolar.modes import existing
from mcsim.bipolar.theory.beam_biposh import ScannedBeam, beam_biposh
from mcsim.bipolar.theory.cmb_biposh import cmb_biposh_exact, cmb_biposh_leading

LMAX, MMAX = 6, 4
CL = 1.0 / (1.0 + np.arange(LMAX + 1)) ** 2
ALL_MODES = [(L, M, d) for L in range(4) for M in range(-L, L + 1) for d in range(-L, L + 1)]


class Channel(NamedTuple):
    beam: ScannedBeam
    matrix: np.ndarray  # [l1, m1 + LMAX, l, m + LMAX]: a~ = K a


def sphere(rings):
    x, weight = np.polynomial.legendre.leggauss(rings)
    phi = 2 * pi * np.arange(2 * rings) / (2 * rings)
    theta, phi = (a.ravel() for a in np.meshgrid(np.arccos(x), phi, indexing="ij"))
    return theta, phi, np.repeat(weight, 2 * rings) * pi / rings


def spin_harmonic(s, l, m, theta, phi):  # noqa: E741
    """Goldberg et al. 1967, eq. 3.1, with the Condon-Shortley phase."""
    total = np.zeros_like(theta)
    for r in range(max(0, m - s), min(l - s, l + m) + 1):
        total = total + (-1) ** (l - r - s + m) * comb(l - s, r) * comb(l + s, r + s - m) * np.cos(theta / 2) ** (
            2 * r + s - m
        ) * np.sin(theta / 2) ** (2 * l - 2 * r - s + m)
    norm = (2 * l + 1) / (4 * pi) * factorial(l + m) * factorial(l - m) / (factorial(l + s) * factorial(l - s))
    return np.sqrt(norm) * total * np.exp(1j * m * phi)


def vectors(theta, phi):
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)


def random_blm(rng, ellipticity):
    blm = np.zeros((MMAX + 1, LMAX + 1), dtype=complex)
    for m in range(MMAX + 1):
        draw = rng.standard_normal((2, LMAX + 1))
        blm[m, m:] = ellipticity * (draw[0] + 1j * draw[1])[m:]
    ell = np.arange(LMAX + 1)
    blm[0] = np.sqrt((2 * ell + 1) / (4 * pi)) * np.exp(-0.02 * ell * (ell + 1))
    return blm


def response_at(blm, n1, psi, n2):
    """Beam pointed at n1, x axis at psi from e_theta to e_phi, seen in the directions n2."""
    theta, phi = n1
    south = vectors(theta + pi / 2, phi)
    east = np.array([-np.sin(phi), np.cos(phi), 0.0])
    axis_x = np.cos(psi) * south + np.sin(psi) * east
    axis_z = vectors(theta, phi)
    axis_y = np.cross(axis_z, axis_x)
    azimuth = np.arctan2(n2 @ axis_y, n2 @ axis_x)
    polar = np.arccos(np.clip(n2 @ axis_z, -1, 1))
    beam = np.zeros(len(n2))
    for ell in range(LMAX + 1):
        beam += (blm[0, ell] * sph_harm_y(ell, 0, polar, azimuth)).real
        for m in range(1, min(ell, MMAX) + 1):
            beam += 2 * (blm[m, ell] * sph_harm_y(ell, m, polar, azimuth)).real
    return beam


def make_channel(seed, ellipticity=0.2):
    """Every point of the sky seen twice, in two orientations without any symmetry."""
    rng = np.random.default_rng(seed)
    blm = random_blm(rng, ellipticity)
    theta1, phi1, weight1 = sphere(13)
    theta2, phi2, weight2 = sphere(7)
    psi = 0.4 + np.cos(theta1) + 0.3 * np.sin(2 * phi1 + 0.2) + rng.uniform(0, 1.0, (2, len(theta1)))
    n2 = vectors(theta2, phi2)
    kernel = np.array(
        [
            np.mean([response_at(blm, (theta1[i], phi1[i]), angle[i], n2) for angle in psi], axis=0)
            for i in range(len(theta1))
        ]
    )
    matrix = np.zeros((LMAX + 1, 2 * LMAX + 1, LMAX + 1, 2 * LMAX + 1), dtype=complex)
    analysis = np.zeros((LMAX + 1, 2 * LMAX + 1, len(theta1)), dtype=complex)
    sky = np.zeros((LMAX + 1, 2 * LMAX + 1, len(theta2)), dtype=complex)
    for ell in range(LMAX + 1):
        for m in range(-ell, ell + 1):
            analysis[ell, m + LMAX] = sph_harm_y(ell, m, theta1, phi1).conj() * weight1
            sky[ell, m + LMAX] = sph_harm_y(ell, m, theta2, phi2) * weight2
    matrix = np.einsum("amp,pq,bnq->ambn", analysis, kernel, sky, optimize=True)
    L_max = 2 * LMAX
    w = np.zeros((MMAX + 1, L_max + 1, 2 * L_max + 1), dtype=complex)
    w[0, 0, L_max] = np.sqrt(4 * pi)
    for s in range(1, MMAX + 1):
        moment = np.exp(-1j * s * psi).mean(axis=0)
        for L in range(s, L_max + 1):
            for M in range(-L, L + 1):
                w[s, L, L_max + M] = np.sum(weight1 * moment * spin_harmonic(-s, L, M, theta1, phi1).conj())
    return Channel(ScannedBeam(blm, w), matrix)


def clebsch(L, M, l1, m1, l2, m2):
    return (-1) ** (l1 - l2 + M) * np.sqrt(2 * L + 1) * wigner3j(l1, l2, L, m1, m2, -M)


def explicit_biposh(covariance, L, M, d):
    """Sum of <a_{l1 m1} a*_{l2 m2}> (-1)^{m2} C^{LM}_{l1 m1 l2 -m2} at l2."""
    result = np.full(LMAX + 1, np.nan, dtype=complex)
    for l2 in range(LMAX + 1):
        l1 = l2 - d
        if not (0 <= l1 <= LMAX and abs(d) <= L <= l1 + l2):
            continue
        result[l2] = sum(
            covariance[l1, m1 + LMAX, l2, m1 - M + LMAX] * (-1) ** (m1 - M) * clebsch(L, M, l1, m1, l2, M - m1)
            for m1 in range(max(-l1, M - l2), min(l1, M + l2) + 1)
        )
    return result


@pytest.fixture(scope="module")
def channel_x():
    return make_channel(1)


@pytest.fixture(scope="module")
def channel_y():
    return make_channel(2)


def test_beam_biposh_is_its_definition(channel_x):
    """B^{LM} = sum C^{LM}_{l1 m1 l2 m2} int int B Y*_{l1 m1} Y*_{l2 m2}, complex b_lm with odd m; to round-off."""
    for L, M, d in ALL_MODES:
        expected = explicit_biposh(channel_x.matrix, L, M, d)
        got = beam_biposh(channel_x.beam, (L, M, d), LMAX)
        np.testing.assert_array_equal(np.isnan(got), np.isnan(expected))
        np.testing.assert_array_equal(~np.isnan(got), existing(L, d, LMAX))
        np.testing.assert_allclose(got, expected, atol=1e-12, rtol=0, err_msg=f"{L} {M} {d}")


def test_exact_biposh_is_that_of_the_convolved_sky(channel_x, channel_y):
    """Ordered pair with different beams and scans, every L <= 3, M and d; round-off of sums of ~1e4 terms."""
    covariance = np.einsum("ambn,b,cdbn->amcd", channel_x.matrix, CL, channel_y.matrix.conj(), optimize=True)
    got = cmb_biposh_exact(ALL_MODES, CL, LMAX, channel_x.beam, channel_y.beam)
    for row, mode in zip(got, ALL_MODES, strict=True):
        np.testing.assert_allclose(row, explicit_biposh(covariance, *mode), atol=1e-12, rtol=0, err_msg=f"{mode}")


def test_sky_above_the_analysis_leaks_down(channel_x):
    """The analysis may end below the sky; the sum over l must not."""
    covariance = np.einsum("ambn,b,cdbn->amcd", channel_x.matrix, CL, channel_x.matrix.conj(), optimize=True)
    got = cmb_biposh_exact([(2, 1, 1)], CL, LMAX - 2, channel_x.beam)
    np.testing.assert_allclose(got[0], explicit_biposh(covariance, 2, 1, 1)[: LMAX - 1], atol=1e-12, rtol=0)


def test_exact_power_spectrum_is_that_of_the_convolved_sky(channel_x):
    covariance = np.einsum("ambn,b,cdbn->amcd", channel_x.matrix, CL, channel_x.matrix.conj(), optimize=True)
    expected = np.array([np.trace(covariance[ell, :, ell, :]).real / (2 * ell + 1) for ell in range(LMAX + 1)])
    ell = np.arange(LMAX + 1)
    got = (-1.0) ** ell * cmb_biposh_exact([(0, 0, 0)], CL, LMAX, channel_x.beam)[0].real / np.sqrt(2.0 * ell + 1)
    np.testing.assert_allclose(got, expected, atol=1e-12, rtol=1e-7)


def test_leading_order_misses_second_order_only(channel_x, channel_y):
    """Scaling every b_l,m>0 by 1/10 scales what leading order misses by 1/100 (it is quadratic)."""

    beams, modes = (channel_x.beam, channel_y.beam), [mode for mode in ALL_MODES if mode[0] > 0]
    full, size = missing_at_leading_order(modes, beams, 1.0)
    tenth, _ = missing_at_leading_order(modes, beams, 0.1)
    assert np.nanmax(abs(full)) > 0.05 * size
    np.testing.assert_allclose(tenth, full / 100, atol=1e-12 * size, rtol=0)


def test_leading_order_of_weighted_maps_misses_second_order_only(channel_x, channel_y):
    """The first order of either map's beam goes with the weights of both."""
    beams, rng = [], np.random.default_rng(3)
    for channel in (channel_x, channel_y):
        w, middle = channel.beam.w.copy(), 2 * LMAX
        w[0, 1:3, middle] = rng.normal(size=2)
        w[0, 2, middle + 1] = 0.3 - 0.5j
        w[0, 2, middle - 1] = -w[0, 2, middle + 1].conj()
        beams.append(ScannedBeam(channel.beam.blm, w))
    modes = [(2, 0, 0), (2, 1, 1), (1, 0, 1)]
    full, size = missing_at_leading_order(modes, beams, 1.0)
    tenth, _ = missing_at_leading_order(modes, beams, 0.1)
    assert np.nanmax(abs(full)) > 0.01 * size
    np.testing.assert_allclose(tenth, full / 100, atol=1e-12 * size, rtol=0)


def missing_at_leading_order(modes, beams, factor):
    """What leading order misses if every b_l,m>0 has this factor, and the size of the whole."""
    scaled = []
    for beam in beams:
        blm = beam.blm.copy()
        blm[1:] *= factor
        scaled.append(ScannedBeam(blm, beam.w))
    exact = cmb_biposh_exact(modes, CL, LMAX, *scaled)
    return exact - cmb_biposh_leading(modes, CL, LMAX, *scaled), abs(np.nan_to_num(exact)).max()
