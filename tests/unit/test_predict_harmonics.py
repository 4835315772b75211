"""Coefficients of orientation moments against closed forms, explicit spin harmonics and known power."""

from math import comb, factorial, pi

import ducc0
import healpy as hp
import numpy as np

from mcsim.bipolar.theory.harmonics import (
    negative_spin,
    orientation_harmonics,
    parallel_transport_harmonics,
    spin_functions,
)
from refusals import refused


def spin_harmonic(s, ell, m, theta, phi):
    """Goldberg et al. 1967, eq. 3.1, with the Condon-Shortley phase."""
    total = np.zeros_like(theta)
    for r in range(max(0, m - s), min(ell - s, ell + m) + 1):
        sine, cosine = 2 * ell - 2 * r - s + m, 2 * r + s - m
        coefficient = (-1) ** (ell - r - s + m) * comb(ell - s, r) * comb(ell + s, r + s - m)
        total = total + coefficient * np.cos(theta / 2) ** cosine * np.sin(theta / 2) ** sine
    norm = (2 * ell + 1) / (4 * pi) * factorial(ell + m) * factorial(ell - m) / factorial(ell + s) / factorial(ell - s)
    return np.sqrt(norm) * total * np.exp(1j * m * phi)


def random_coefficients(smax, L_max, seed):
    rng = np.random.default_rng(seed)
    w = np.zeros((smax + 1, L_max + 1, 2 * L_max + 1), dtype=complex)
    w[0, 0, L_max] = np.sqrt(4 * pi)
    for s in range(1, smax + 1):
        for L in range(s, L_max + 1):
            draw = rng.standard_normal((2, 2 * L + 1))
            w[s, L, L_max - L : L_max + L + 1] = draw[0] + 1j * draw[1]
    return w


def test_maps_of_known_coefficients():
    """Every M of L <= 6, spins odd and even; plain pixel sums are wrong by nside^-2, here by less than 2 nside^-2."""
    smax, L_max, nside = 3, 6, 32
    theta, phi = hp.pix2ang(nside, np.arange(12 * nside**2))
    w = random_coefficients(smax, L_max, 1)
    maps = np.zeros((smax, theta.size), dtype=complex)
    for s in range(1, smax + 1):
        for L in range(s, L_max + 1):
            for M in range(-L, L + 1):
                maps[s - 1] += w[s, L, L_max + M] * spin_harmonic(-s, L, M, theta, phi)
    got = orientation_harmonics(maps, L_max)
    np.testing.assert_allclose(got, w, atol=2 / nside**2 * abs(w).max(), rtol=0)


def test_negative_spin_is_the_conjugate_field():
    theta, phi = np.array([0.3, 1.2, 2.9]), np.array([0.1, 4.0, 2.0])
    w = random_coefficients(3, 5, 2)
    mirrored = negative_spin(w)
    for s in (1, 2, 3):
        pairs = [(L, M) for L in range(s, 6) for M in range(-L, L + 1)]
        field = sum(w[s, L, 5 + M] * spin_harmonic(-s, L, M, theta, phi) for L, M in pairs)
        conjugate = sum(mirrored[s, L, 5 + M] * spin_harmonic(s, L, M, theta, phi) for L, M in pairs)
        np.testing.assert_allclose(conjugate, field.conj(), atol=1e-13, rtol=0)


def test_power_of_parallel_transport():
    """83.3, 10, 3.1, 1.35 % of the power of w_2 at L = 2, 4, 6, 8; all of it when summed."""
    w = parallel_transport_harmonics(2, 400)
    share = abs(w[2, :, 400]) ** 2 / (4 * pi)
    np.testing.assert_allclose(share[[2, 4, 6, 8]], [5 / 6, 1 / 10, 13 / 420, 17 / 1260], rtol=1e-12)
    # What is above L falls as 4/L^2.
    np.testing.assert_allclose(share.sum(), 1.0, atol=5 / 400**2)


def test_parallel_transport_closed_form():
    """Spin 2: int P_L^2 dx = 4 for even L; so w_{2,L0} = sqrt(4pi (2L+1)) 2 sqrt((L-2)!/(L+2)!)."""
    L = np.arange(2, 301, 2)
    w = parallel_transport_harmonics(3, 300, psi0=0.7)
    expected = 2 * np.sqrt(4 * pi * (2 * L + 1.0) / ((L + 2.0) * (L + 1) * L * (L - 1)))
    np.testing.assert_allclose(w[2, L, 300], expected * np.exp(-1.4j), rtol=1e-11)
    assert abs(w[2, 3::2, 300]).max() < 1e-12
    # Spin 1: (-1)Y_10 = -sqrt(3/8pi) sin(theta), whose integral is -pi^2 sqrt(3/8pi).
    np.testing.assert_allclose(w[1, 1, 300], -(pi**2) * np.sqrt(3 / (8 * pi)) * np.exp(-0.7j), rtol=1e-13)


def test_maps_agree_with_integrals_over_rings():
    smax, L_max, nside = 3, 12, 64
    theta, _ = hp.pix2ang(nside, np.arange(12 * nside**2))
    rings, spins = ducc0.misc.GL_thetas(200), np.arange(1, smax + 1)[:, None]
    # Fields of spin s must vanish as sin^s at the poles to be smooth.
    profiles, maps = (np.exp(1j * np.cos(t)) * np.sin(t) ** spins for t in (rings, theta))
    expected = np.zeros((smax + 1, L_max + 1, 2 * L_max + 1), dtype=complex)
    weights = ducc0.misc.GL_weights(200, 1)  # of the sphere: 2 pi is in them
    functions = spin_functions(smax, L_max, rings)
    expected[1:, :, L_max] = np.einsum("slt,st->sl", functions[1:], profiles * weights)
    expected[0, 0, L_max] = np.sqrt(4 * pi)
    got = orientation_harmonics(maps, L_max)
    np.testing.assert_allclose(got, expected, atol=2 / nside**2 * abs(got).max(), rtol=0)


def test_a_map_that_is_none():
    with refused("100 pixels"):
        orientation_harmonics(np.zeros((2, 100), dtype=complex), 4)
    with refused("w", "finite"):
        orientation_harmonics(np.full((2, 48), np.nan + 0j), 4)
    with refused("(48,)", "(smax, npix)"):
        orientation_harmonics(np.zeros(48, dtype=complex), 4)
