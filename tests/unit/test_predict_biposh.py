"""Beam-BipoSH and CMB BipoSH against the closed forms of arXiv:1210.7318, corrected, and explicit sums."""

from math import factorial, pi, sqrt

import numpy as np
import pytest
from scipy.special import ive, sph_harm_y
from wignernj import wigner3j

from mcsim.bipolar.modes import bennett_factor, to_bennett
from mcsim.bipolar.theory.beam_biposh import ScannedBeam, beam_biposh
from mcsim.bipolar.theory.cmb_biposh import cmb_biposh_exact, cmb_biposh_leading, noise_biposh
from mcsim.bipolar.theory.harmonics import parallel_transport_harmonics
from refusals import refused


def elliptical_gaussian(fwhm_arcmin, eccentricity, lmax, mmax=4):
    """Major axis along x: b_lm = sqrt((2l+1)/4pi) exp(-(l+1/2)^2 (s1^2+s2^2)/4) I_{m/2}((l+1/2)^2 (s1^2-s2^2)/4)."""
    major = np.radians(fwhm_arcmin / 60) / sqrt(8 * np.log(2))
    minor = major * sqrt(1 - eccentricity**2)
    ell = np.arange(lmax + 1)
    argument = (ell + 0.5) ** 2 * (major**2 - minor**2) / 4
    blm = np.zeros((mmax + 1, lmax + 1), dtype=complex)
    for m in range(0, mmax + 1, 2):
        radial = np.exp(argument - (ell + 0.5) ** 2 * (major**2 + minor**2) / 4) * ive(m // 2, argument)
        blm[m] = np.where(ell >= m, np.sqrt((2 * ell + 1) / (4 * pi)) * radial, 0.0)
    return blm / (blm[0, 0] * sqrt(4 * pi))


def circular(window):
    ell = np.arange(len(window))
    return (np.sqrt((2 * ell + 1) / (4 * pi)) * window)[None].astype(complex)


def clebsch(L, M, l1, m1, l2, m2):
    return (-1) ** (l1 - l2 + M) * sqrt(2 * L + 1) * wigner3j(l1, l2, L, m1, m2, -M)


def closed_form_integral(l1, l2, m2, sign):
    """I^{l1 l2}_{m2,+-2} for m2 != 0 from the paper's kappa_i, with what its text leaves out.

    kappa = sqrt((l2+2)!/(l2-2)!); kappa_0 and kappa_{+-2} enter for l1 + l2 even only, kappa_{+-1} for odd
    only. For l' + l1 even the integral of d^{l'}_{m0} d^{l1}_{m0}/sin(theta) is
    1/|m| sqrt((l< + m)! (l> - m)!/((l< - m)! (l> + m)!)), l< and l> the smaller and larger of l' and l1.
    """
    m, lt = m2, l2
    kappas = {
        0: m**2 / (lt**2 * (lt + 1) ** 2)
        - (lt**2 - m**2) / (lt**2 * (4 * lt**2 - 1))
        - ((lt + 1) ** 2 - m**2) / ((lt + 1) ** 2 * (2 * lt + 1) * (2 * lt + 3)),
        1: sign * 2 * m * sqrt((lt + 1) ** 2 - m**2) / (lt * (lt + 1) * (lt + 2) * (2 * lt + 1)),
        -1: -sign * 2 * m * sqrt(lt**2 - m**2) / (lt * (lt**2 - 1) * (2 * lt + 1)),
        2: sqrt(((lt + 1) ** 2 - m**2) * ((lt + 2) ** 2 - m**2)) / ((lt + 1) * (lt + 2) * (2 * lt + 1) * (2 * lt + 3)),
        -2: sqrt(max((lt**2 - m**2) * ((lt - 1) ** 2 - m**2), 0)) / (lt * (lt - 1) * (4 * lt**2 - 1)),
    }
    total = 0.0
    for step, kappa in kappas.items():
        low, high = sorted((l1, lt + step))
        if (low + high) % 2 or low < abs(m):
            continue
        ratio = (
            factorial(low + abs(m)) * factorial(high - abs(m)) / (factorial(low - abs(m)) * factorial(high + abs(m)))
        )
        total += kappa * sqrt(ratio) / abs(m)
    kappa = sqrt(factorial(lt + 2) / factorial(lt - 2))
    return (-1) ** m * sqrt((2 * l1 + 1) / (4 * pi)) * kappa * total


def integral_at_m_zero(l1, l2):
    """I^{l1 l2}_{0,+-2}, as printed."""
    if (l1 + l2) % 2 or l1 > l2:
        return 0.0
    root = sqrt(factorial(l2 - 2) / factorial(l2 + 2))
    bracket = 4.0 if l1 < l2 else (4 * l2 - 2 * l2 * (l2 + 1)) / (2 * l2 + 1)
    return sqrt((2 * l1 + 1) / (4 * pi)) * root * bracket


def paper_beam_biposh(L, l1, l2, b_l2, psi0):
    """Eq. BB: 2 pi sum_m' b e^{-i m' psi0} sum_m2 C^{L0}_{l1 -m2 l2 m2} I_{m2,m'} over m' = +-2."""
    total = 0.0
    for sign, b in ((1, b_l2), (-1, np.conj(b_l2))):
        for m2 in range(-min(l1, l2), min(l1, l2) + 1):
            integral = integral_at_m_zero(l1, l2) if m2 == 0 else closed_form_integral(l1, l2, m2, sign)
            total += b * np.exp(-2j * sign * psi0) * clebsch(L, 0, l1, -m2, l2, m2) * integral
    return 2 * pi * total


@pytest.mark.parametrize("L", [1, 2, 3, 4, 6])
def test_parallel_transport_is_the_papers_closed_form(L):
    """Both parities (a complex b_l2 has no reflection symmetry), l1 below, at and above l2; to round-off."""
    lmax, psi0 = 12, 0.3
    blm = np.zeros((3, lmax + 1), dtype=complex)
    blm[2, 2:] = (1.0 + 0.4j) / np.arange(3, lmax + 2)
    beam = ScannedBeam(blm, parallel_transport_harmonics(2, L, psi0))
    for d in range(-L, L + 1):
        got = beam_biposh(beam, (L, 0, d), lmax)
        for l2 in range(2, lmax + 1):
            if 0 <= l2 - d <= lmax and 2 * l2 - d >= L:
                expected = paper_beam_biposh(L, l2 - d, l2, blm[2, l2], psi0)
                np.testing.assert_allclose(got[l2], expected, atol=1e-12, rtol=0, err_msg=f"{L} {d} {l2}")


def test_a_number_of_the_paper():
    """B^{20}_{44} per 2 Re b_42 is 1.916 (0.752 as printed)."""
    blm = np.zeros((3, 5), dtype=complex)
    blm[2, 4] = 0.5
    beam = ScannedBeam(blm, parallel_transport_harmonics(2, 2))
    assert beam_biposh(beam, (2, 0, 0), 4)[4].real == pytest.approx(1.916, abs=5e-4)


def test_circular_beam():
    lmax = 30
    window = np.exp(-0.001 * np.arange(lmax + 1) ** 2)
    beam = ScannedBeam(circular(window), parallel_transport_harmonics(4, 4))
    ell = np.arange(lmax + 1)
    np.testing.assert_allclose(
        beam_biposh(beam, (0, 0, 0), lmax), (-1.0) ** ell * window * np.sqrt(2 * ell + 1), rtol=1e-14
    )
    for mode in [(1, 0, 0), (2, 0, 0), (2, 1, -2), (3, 2, 1)]:
        assert np.nanmax(abs(beam_biposh(beam, mode, lmax))) == 0.0
    cl = 1.0 / (ell + 1.0) ** 2
    monopole = cmb_biposh_exact([(0, 0, 0)], cl, lmax, beam)[0]
    np.testing.assert_allclose(monopole, (-1.0) ** ell * np.sqrt(2 * ell + 1) * cl * window**2, rtol=1e-12)


@pytest.mark.parametrize("kind", [cmb_biposh_leading, cmb_biposh_exact])
def test_major_axis_along_the_meridian(kind):
    """x along e_theta: A^{20}_ll < 0 and A^{20}_{l-2,l} > 0 (Bennett); turned by 90 deg the signs turn."""
    lmax = 300
    cl = 1.0 / (np.arange(lmax + 1) + 1.0) ** 2
    modes = [(2, 0, 0), (2, 0, 2)]
    for psi0, sign in ((0.0, 1.0), (pi / 2, -1.0)):
        beam = ScannedBeam(elliptical_gaussian(30.0, 0.4, lmax), parallel_transport_harmonics(4, 16, psi0))
        spectra = to_bennett(kind(modes, cl, lmax, beam), modes).real
        assert np.all(sign * spectra[0, 50:250] < 0)
        assert np.all(sign * spectra[1, 50:250] > 0)


def test_wmap_1():
    """Eq. WMAP1, Bennett normalisation: (-1)^l 2 sqrt(5) C_l B^00 B^20 / ((2l+1)^{3/2} C^{20}_{l0l0})."""
    lmax = 20
    cl = 1.0 / (np.arange(lmax + 1) + 1.0)
    beam = ScannedBeam(elliptical_gaussian(600.0, 0.5, lmax), parallel_transport_harmonics(2, 2))
    got = to_bennett(cmb_biposh_leading([(2, 0, 0)], cl, lmax, beam), [(2, 0, 0)])[0]
    monopole, quadrupole = (beam_biposh(beam, (L, 0, 0), lmax) for L in (0, 2))
    for ell in range(2, lmax + 1):
        factor = (-1) ** ell * 2 * sqrt(5) / ((2 * ell + 1) ** 1.5 * clebsch(2, 0, ell, 0, ell, 0))
        assert got[ell] == pytest.approx(factor * cl[ell] * monopole[ell] * quadrupole[ell], rel=1e-12)


@pytest.mark.parametrize("kind", [cmb_biposh_leading, cmb_biposh_exact])
def test_exchange_of_a_pair_and_of_m(kind):
    """A^{LM,XY}_{l1 l2} = (-1)^{l1+l2-L} A^{LM,YX}_{l2 l1} and A^{L,-M} = (-1)^{l1+l2-L+M} conj(A^{LM}) for a pair."""
    lmax = 40
    cl = 1.0 / (np.arange(lmax + 1) + 1.0) ** 2
    rng = np.random.default_rng(3)
    channels = []
    for fwhm in (300.0, 500.0):
        blm = elliptical_gaussian(fwhm, 0.5, lmax, mmax=3)
        blm[1], blm[3] = 0.3j * blm[2], 0.1 * blm[2]
        w = parallel_transport_harmonics(3, 4)
        for L in range(1, 5):
            draw = rng.standard_normal((2, 3, 2 * L + 1))
            w[1:, L, 4 - L : 5 + L] += np.tri(3, k=L - 1)[:, :1] * (draw[0] + 1j * draw[1])
        w[2, 1], w[3, 1:3] = 0.0, 0.0
        channels.append(ScannedBeam(blm, w))
    x, y = channels
    for L, M, d in [(1, 1, 1), (2, 1, 0), (2, 2, 1), (2, 0, 2), (3, 2, 2)]:
        straight, mirrored = kind([(L, M, d), (L, -M, d)], cl, lmax, x, y)
        swapped = kind([(L, M, -d)], cl, lmax, y, x)[0]
        parity = (-1) ** (d + L)
        np.testing.assert_allclose(mirrored, parity * (-1) ** M * straight.conj(), atol=1e-14)
        np.testing.assert_allclose(straight[d:], parity * swapped[: lmax + 1 - d], atol=1e-14)


def test_bennett_factor():
    for L, d in [(1, 1), (2, 0), (2, 2), (2, -2), (3, 1)]:
        factor = bennett_factor((L, 0, d), 12)
        for l2 in range(4, 9):
            l1 = l2 - d
            norm = sqrt((2 * l1 + 1) * (2 * l2 + 1)) * clebsch(L, 0, l1, 0, l2, 0)
            assert factor[l2] == pytest.approx(sqrt(2 * L + 1) / norm, rel=1e-12)


def test_noise_is_an_explicit_sum():
    """Uncorrelated noise with variance map V: <n_{l1 m1} n*_{l2 m2}> = int Y*_{l1 m1} Y_{l2 m2} V by Gauss-Legendre."""
    lmax, L_max = 4, 3
    x, weight = np.polynomial.legendre.leggauss(12)
    theta, phi = (a.ravel() for a in np.meshgrid(np.arccos(x), 2 * pi * np.arange(24) / 24, indexing="ij"))
    weight = np.repeat(weight, 24) * 2 * pi / 24
    variance = (
        1.0 + 0.5 * np.sin(theta) * np.cos(phi - 0.3) + np.cos(theta) ** 3 + 0.2 * np.sin(2 * theta) * np.sin(phi)
    )
    coefficients = np.zeros((L_max + 1, 2 * L_max + 1), dtype=complex)
    for L in range(L_max + 1):
        for M in range(-L, L + 1):
            coefficients[L, L_max + M] = np.sum(weight * variance * sph_harm_y(L, M, theta, phi).conj())
    modes = [(0, 0, 0), (1, 0, 1), (1, 1, -1), (2, 1, 0), (2, 0, 1), (3, 1, 1)]
    got = noise_biposh(modes, coefficients, lmax)
    for row, (L, M, d) in zip(got, modes, strict=True):
        for l2 in range(lmax + 1):
            l1 = l2 - d
            if not (0 <= l1 <= lmax and l1 + l2 >= L):
                assert np.isnan(row[l2])
                continue
            expected = sum(
                np.sum(weight * variance * sph_harm_y(l1, m1, theta, phi).conj() * sph_harm_y(l2, m1 - M, theta, phi))
                * (-1) ** (m1 - M)
                * clebsch(L, M, l1, m1, l2, M - m1)
                for m1 in range(max(-l1, M - l2), min(l1, M + l2) + 1)
            )
            assert row[l2] == pytest.approx(expected, abs=1e-12)


def test_user_errors():
    beam = ScannedBeam(circular(np.ones(5)), parallel_transport_harmonics(1, 2))
    with refused("L=1", "M=2", "d=0"):
        beam_biposh(beam, (1, 2, 0), 4)
    for kind in (cmb_biposh_leading, cmb_biposh_exact):
        with refused("L = 2", "L = 3"):
            kind([(2, 0, 0), (3, 0, 1)], np.ones(5), 4, beam)
    with refused("L = 2", "L = 3"):
        beam_biposh(beam, (3, 0, 1), 4)
    with refused("L = 1", "L = 2"):
        noise_biposh([(0, 0, 0), (2, 0, 0)], np.zeros((2, 3), dtype=complex), 4)
    with refused("ell = 3", "lmax", 4):
        cmb_biposh_leading([(2, 0, 0)], np.ones(4), 4, beam)
    with refused("ell = 3", "lmax", 4):
        cmb_biposh_exact([(2, 0, 0)], np.ones(4), 4, beam)
    for kind in (cmb_biposh_leading, cmb_biposh_exact):
        for wrong in (np.array([1.0, 1.0, np.nan, 1.0, 1.0]), np.array([1.0, -1.0, 1.0, 1.0, 1.0])):
            with refused("spectrum"):
                kind([(2, 0, 0)], wrong, 4, beam)
    for blm, w in [(beam.blm[0], beam.w), (beam.blm, beam.w[0]), (beam.w, beam.blm), (beam.blm, beam.w[:, :, 1:])]:
        with refused(blm.shape, w.shape):
            ScannedBeam(blm, w)
    with refused("blm", "finite"):
        ScannedBeam(np.nan * beam.blm, beam.w)
    with refused("(3, 3)", "(3, 5)"):
        noise_biposh([(2, 0, 0)], np.zeros((3, 3), dtype=complex), 4)
    with refused("L2M0d1", "parity"):
        to_bennett(np.zeros((1, 5)), [(2, 0, 1)])
    with refused("d=3"):
        bennett_factor((2, 0, 3), 4)
