"""Spin-harmonic coefficients w_{s,LM} of the orientation moments w_s = <e^{-i s psi}>, and of weights of pixels.

Those of moments are complex arrays of shape (smax + 1, L_max + 1, 2 L_max + 1) with w_{s,LM} at ``[s, L, L_max + M]``
and zero where |M| > L or L < s: w_s = sum_LM w_{s,LM} (-s)Y_LM. Weights W(n) take the place of w_0 = 1.
"""

import ducc0
import numpy as np
from numpy.typing import NDArray

from mcsim.errors import InputError
from mcsim.sphere import alm as alm_
from mcsim.sphere import healpix
from mcsim.sphere.checks import check_angle, check_finite, check_shape, check_whole, nside_of


def orientation_harmonics(
    w: NDArray[np.complex128], L_max: int, nthreads: int = 1, weight: NDArray[np.float64] | None = None
) -> NDArray[np.complex128]:
    """Return w_{s,LM} of moment maps, w_s(n) = <e^{-i s psi}> for s = 1..smax, HEALPix RING, shape (smax, npix).

    ``weight``, shape (npix,): of the pixels of a map that is analysed; the result is then that of W and of W w_s. By
    default W = w_0 = 1 everywhere. Raise InputError if a map is not finite or does not have 12 nside^2 pixels.

    Notes
    -----
    The integrals are sums over pixels of equal weight, wrong by about nside^-2 of the largest coefficient where the
    moments are smooth (tests/unit/test_predict_harmonics.py), 4e-6 at nside 512.
    """
    if np.ndim(w) != 2:
        raise InputError(f"w has shape {np.shape(w)}, but moment maps are (smax, npix).")
    smax, npix = w.shape
    nside_of(npix, "a moment map")
    check_whole(L_max, "L_max")
    check_finite(w, "w")
    area = 4 * np.pi / npix
    result = _isotropic_zero(smax, L_max)
    if weight is not None:
        check_shape(weight, (npix,), "the weight")
        w, result[0] = w * weight, map_harmonics(weight, L_max, nthreads)
    for s in range(1, min(smax, L_max) + 1):
        conjugate = np.stack([w[s - 1].real, -w[s - 1].imag]) * area
        gradient, curl = healpix.adjoint(conjugate, L_max, nthreads, spin=s)
        # w_{s,LM} = (-1)^{s+M} conj((conj w_s)_{L,-M}) from E and B of the spin-(+s) field conj(w_s).
        for M in range(L_max + 1):
            low, first = max(M, s), alm_.start(L_max, M)
            span = slice(first + low, first + L_max + 1)
            result[s, low:, L_max - M] = -((-1) ** (s + M)) * (gradient[span] + 1j * curl[span]).conj()
            result[s, low:, L_max + M] = -((-1) ** s) * (gradient[span] - 1j * curl[span])
    return result


def map_harmonics(map_: NDArray[np.float64], L_max: int, nthreads: int = 1) -> NDArray[np.complex128]:
    """Return the coefficients of a real HEALPix map in RING order, shape (L_max + 1, 2 L_max + 1), M at L_max + M.

    Those beyond 3 nside - 1 are zero.
    """
    top = min(L_max, 3 * nside_of(map_.size, "the map") - 1)
    alm = healpix.analysis(map_, top, iterations=3, nthreads=nthreads)
    result = np.zeros((L_max + 1, 2 * L_max + 1), dtype=np.complex128)
    for M in range(top + 1):
        first = alm_.start(top, M)
        column = alm[first + M : first + top + 1]
        result[M : top + 1, L_max - M] = (-1) ** M * column.conj()
        result[M : top + 1, L_max + M] = column
    return result


def parallel_transport_harmonics(smax: int, L_max: int, psi0: float = 0.0) -> NDArray[np.complex128]:
    """Return w_{s,L0} of w_s = e^{-i s psi0} everywhere, psi0 in radians, exactly.

    Notes
    -----
    A constant w_s is singular at the poles as a spin field, so the coefficients fall only as L^{-3/2}. Each is an
    integral that a finite rule gives exactly: Gauss-Legendre for even s, where d^L_{s0} is a polynomial in cos(theta),
    and equal steps in theta for odd s, where d^L_{s0} sin(theta) is a cosine series. The power of w_2 at L = 2, 4, 6,
    8 is 83.3, 10, 3.1, 1.35 %.
    """
    check_whole(smax, "smax")
    check_whole(L_max, "L_max")
    check_angle(psi0, "psi0")
    result = _isotropic_zero(smax, L_max)
    gauss = spin_functions(smax, L_max, ducc0.misc.GL_thetas(L_max + 2))
    gauss_weights = ducc0.misc.GL_weights(L_max + 2, 1)  # of the sphere: they include 2 pi
    steps = 2 * L_max + 4
    theta = np.pi * np.arange(steps + 1) / steps
    equal = spin_functions(smax, L_max, theta)
    equal_weights = 2 * np.pi * np.pi / steps * np.sin(theta)
    for s in range(1, smax + 1):
        integral = gauss[s] @ gauss_weights if s % 2 == 0 else equal[s] @ equal_weights
        result[s, :, L_max] = np.exp(-1j * s * psi0) * integral
    return result


def _isotropic_zero(smax: int, L_max: int) -> NDArray[np.complex128]:
    result = np.zeros((smax + 1, L_max + 1, 2 * L_max + 1), dtype=np.complex128)
    result[0, 0, L_max] = np.sqrt(4 * np.pi)
    return result


def spin_functions(smax: int, L_max: int, theta: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (-s)Y_L0(theta) = sqrt((2L+1)/4pi) d^L_{s0}(theta) for s = 0..smax, shape (smax + 1, L_max + 1, ntheta).

    Notes
    -----
    d^s_{s0} = (-1)^s sqrt((2s)!)/(2^s s!) sin^s(theta), then upwards in L, which is the stable direction.
    """
    x = np.cos(theta)
    result = np.zeros((smax + 1, L_max + 1, len(theta)))
    start = np.ones_like(x)
    for s in range(min(smax, L_max) + 1):
        if s > 0:
            start = -start * np.sin(theta) * np.sqrt((2 * s - 1) / (2 * s))
        below, current = np.zeros_like(x), start
        for L in range(s, L_max + 1):
            result[s, L] = np.sqrt((2 * L + 1) / (4 * np.pi)) * current
            above = (2 * L + 1) * x * current - np.sqrt(float(L * L - s * s)) * below
            below, current = current, above / np.sqrt(float((L + 1) ** 2 - s * s))
    return result


def negative_spin(w: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Return w_{-s,LM} = (-1)^{s+M} conj(w_{s,L,-M}), in the same layout."""
    smax, width = w.shape[0] - 1, w.shape[2]
    sign_s = (-1.0) ** np.arange(smax + 1)
    sign_m = (-1.0) ** np.arange(-(width // 2), width // 2 + 1)
    return sign_s[:, None, None] * sign_m * w[:, :, ::-1].conj()
