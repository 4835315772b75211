"""Variances and information against explicit covariances."""

from math import sqrt

import numpy as np
import pytest
from wignernj import wigner3j

from mcsim.bipolar.modes import existing
from mcsim.bipolar.theory.detectability import Spectra, fisher_information, isotropic_variance, signal_to_noise
from refusals import refused

LMAX = 4


def clebsch(L, M, l1, m1, l2, m2):
    return (-1) ** (l1 - l2 + M) * sqrt(2 * L + 1) * wigner3j(l1, l2, L, m1, m2, -M)


def random_signal(rng, modes, maps):
    """Raw BipoSH dA[X, Y, mode, l2] of d >= 0, obeying A^{XY}_{ll} = (-1)^L A^{YX}_{ll} and the reality of M = 0."""
    signal = np.zeros((maps, maps, len(modes), LMAX + 1), dtype=complex)
    for i, (L, M, d) in enumerate(modes):
        draw = rng.standard_normal((2, maps, maps, LMAX + 1))
        values = draw[0] + 1j * draw[1]
        if M == 0:
            values = draw[0] * (1.0 if (d + L) % 2 == 0 else 1j)
        if d == 0:
            values = values + (-1) ** L * values.transpose(1, 0, 2)
        signal[:, :, i] = np.where(existing(L, d, LMAX), values, np.nan)
    return signal


def covariance_of(signal, modes):
    """<a^X_{l1 m1} a^Y*_{l2 m2}>, all pairs, from the expansion in Clebsch-Gordan coefficients."""
    maps = signal.shape[0]
    index = [(x, ell, m) for x in range(maps) for ell in range(LMAX + 1) for m in range(-ell, ell + 1)]
    place = {key: i for i, key in enumerate(index)}
    full = np.zeros((len(index), len(index)), dtype=complex)
    for i, (L, M, d) in enumerate(modes):
        for l2 in np.flatnonzero(existing(L, d, LMAX)).tolist():
            l1 = l2 - d
            for x in range(maps):
                for y in range(maps):
                    value = signal[x, y, i, l2]
                    mirrored = (-1) ** (l1 + l2 - L + M) * np.conj(value)
                    orders = [(M, value)] if M == 0 else [(M, value), (-M, mirrored)]
                    for order, a in orders:
                        for m1 in range(max(-l1, order - l2), min(l1, order + l2) + 1):
                            m2 = m1 - order
                            term = a * (-1) ** m2 * clebsch(L, order, l1, m1, l2, -m2)
                            full[place[x, l1, m1], place[y, l2, m2]] += term
                            if d > 0:
                                full[place[y, l2, m2], place[x, l1, m1]] += np.conj(term)
    return full, index


def test_information_is_the_trace():
    """1/2 Tr[C^-1 dC C^-1 dC] of two maps, over the a_lm of both signs of m (each real degree of freedom once)."""
    rng = np.random.default_rng(5)
    modes = [(L, M, d) for L in range(4) for M in range(L + 1) for d in range(L + 1)]
    signal = random_signal(rng, modes, 2)
    cl = np.zeros((2, 2, LMAX + 1))
    cl[0, 0], cl[1, 1] = rng.uniform(1.0, 2.0, (2, LMAX + 1))
    cl[0, 1] = cl[1, 0] = rng.uniform(-0.5, 0.9, LMAX + 1)
    change, index = covariance_of(signal, modes)
    np.testing.assert_allclose(change, change.conj().T, atol=1e-12)
    isotropic = np.array([[cl[x, y, l1] * (l1 == l2) * (m1 == m2) for y, l2, m2 in index] for x, l1, m1 in index])
    ratio = np.linalg.solve(isotropic, change)
    expected = 0.5 * np.trace(ratio @ ratio).real
    assert fisher_information(np.nan_to_num(signal), modes, cl) == pytest.approx(expected, rel=1e-12)
    assert fisher_information(signal, modes, cl, f_sky=0.25) == pytest.approx(0.25 * expected, rel=1e-12)


def test_single_map_information_is_the_quadratic_sum_of_its_modes():
    rng = np.random.default_rng(6)
    modes = [(L, M, d) for L in (1, 2, 3) for M in range(L + 1) for d in range(L + 1) if d > 0 or L % 2 == 0]
    signal = random_signal(rng, modes, 1)
    cl = rng.uniform(1.0, 2.0, LMAX + 1)
    each = signal_to_noise(signal[0, 0], modes, Spectra(cl), f_sky=0.5)
    assert np.sum(each**2) == pytest.approx(fisher_information(signal, modes, cl[None, None], f_sky=0.5), rel=1e-12)
    low = signal_to_noise(signal[0, 0], modes, Spectra(cl), f_sky=0.5, ell_range=(0, 2))
    high = signal_to_noise(signal[0, 0], modes, Spectra(cl), f_sky=0.5, ell_range=(3, LMAX))
    np.testing.assert_allclose(np.hypot(low, high), each, rtol=1e-12)


def test_degrees_without_power_tell_nothing_and_maps_that_are_nearly_the_same_tell_much():
    """Of a correlation of 0.999 at l = 2 and more, and of maps without monopole and dipole."""
    cl = np.zeros((2, 2, 6))
    cl[..., 2:] = np.array([[1.0, 0.999], [0.999, 1.0]])[:, :, None]
    signal = np.zeros((2, 2, 1, 6), dtype=complex)
    signal[0, 0, 0, 1:] = [7.0, 0.0, 1.0, 0.0, 0.0]
    inverse = np.linalg.inv(cl[:, :, 3])
    assert fisher_information(signal, [(2, 0, 0)], cl) == pytest.approx(0.5 * inverse[0, 0] ** 2, rel=1e-9)


def test_variances_of_isotropic_maps():
    """E|A|^2 from 4000 pairs of Gaussian maps, held to 5 of the mean's own standard errors."""
    rng = np.random.default_rng(7)
    draws, lmax = 4000, 3
    x_cl, y_cl, cross = np.array([4.0, 3.0, 2.0, 1.0]), np.array([1.0, 3.0, 5.0, 2.0]), np.array([1.0, 1.5, 2.0, -1.0])
    mixing = np.linalg.cholesky(np.moveaxis([[x_cl, cross], [cross, y_cl]], -1, 0))
    alm = np.zeros((2, draws, lmax + 1, 2 * lmax + 1), dtype=complex)
    for ell in range(lmax + 1):
        for m in range(ell + 1):
            real, imaginary = rng.standard_normal((2, 2, draws))
            white = real if m == 0 else (real + 1j * imaginary) / sqrt(2)
            alm[:, :, ell, lmax + m] = mixing[ell] @ white
            alm[:, :, ell, lmax - m] = (-1) ** m * alm[:, :, ell, lmax + m].conj()
    modes = [(1, 0, 0), (1, 1, 1), (2, 0, 0), (2, 1, 0), (2, 2, -1), (3, 0, 1)]
    for channels, expected in (
        ((0, 1), isotropic_variance(modes, Spectra(x_cl, y_cl, cross))),
        ((0, 0), isotropic_variance(modes, Spectra(x_cl))),
    ):
        first, second = (alm[i] for i in channels)
        for row, (L, M, d) in zip(expected, modes, strict=True):
            for l2 in np.flatnonzero(existing(L, d, lmax)).tolist():
                l1 = l2 - d
                estimate = sum(
                    first[:, l1, lmax + m1]
                    * second[:, l2, lmax + m1 - M].conj()
                    * (-1) ** (m1 - M)
                    * clebsch(L, M, l1, m1, l2, M - m1)
                    for m1 in range(max(-l1, M - l2), min(l1, M + l2) + 1)
                )
                power = np.mean(abs(estimate) ** 2)
                scatter = np.std(abs(estimate) ** 2) / sqrt(draws)
                assert abs(power - row[l2]) <= 5 * scatter + 1e-12


def test_user_errors():
    cl = np.ones(5)
    signal = np.zeros((1, 5), dtype=complex)
    with refused("f_sky", 1.2):
        signal_to_noise(signal, [(2, 0, 0)], Spectra(cl), f_sky=1.2)
    with refused("f_sky", "0.0"):
        fisher_information(signal[None, None], [(2, 0, 0)], cl[None, None], f_sky=0.0)
    with refused("d=-1"):
        fisher_information(signal[None, None], [(2, 0, -1)], cl[None, None])
    with refused("L=0"):
        signal_to_noise(signal, [(0, 0, 0)], Spectra(cl))
    for ells in ((3, 2), (-1, 4)):  # an empty slice: a signal to noise of zero
        with refused("ell_range", *ells):
            signal_to_noise(signal, [(2, 0, 0)], Spectra(cl), ell_range=ells)
    with refused("cl_total", "finite"):  # left out as if without power
        fisher_information(signal[None, None], [(2, 0, 0)], np.where(cl < 2, np.nan, cl)[None, None])
    with refused("(1, 4)", "(1, 5)"):
        signal_to_noise(signal[:, :4], [(2, 0, 0)], Spectra(cl))
    with refused("y", "ell = 2", "lmax", 4):
        isotropic_variance([(2, 0, 0)], Spectra(cl, cl[:3], cl))
    with refused("x", "finite"):
        isotropic_variance([(2, 0, 0)], Spectra(np.nan * cl))
    with refused("cross"):
        isotropic_variance([(2, 0, 0)], Spectra(cl, cl))
