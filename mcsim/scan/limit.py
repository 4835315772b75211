"""Exact long-time limit of hits and orientation moments for incommensurate spin, precession and orbit."""

import math

import numpy as np
from numpy.typing import NDArray
from scipy.special import ellipj, ellipkm1

from mcsim.errors import InputError
from mcsim.scan.model import LineOfSight, ScanModel

_NODES = 128
_FAST_PRECESSION = 50.0
_GRADED = 60


def limit_moments(
    model: ScanModel, theta: NDArray[np.float64], smax: int, line_of_sight: str | None = None
) -> tuple[NDArray[np.float64], NDArray[np.complex128]]:
    """Hits and orientation moments after infinite time, as functions of ecliptic colatitude.

    Parameters
    ----------
    model
        The survey.
    theta
        Ecliptic colatitudes in radians, shape (n,).
    smax
        Largest s (>= 1).
    line_of_sight
        Name of the line of sight; None: the first of the model's default ones.

    Returns
    -------
    density : ndarray, shape (n,)
        Hits per solid angle over their mean over the whole sky; 0 where nothing is observed; finite, though
        large, on a caustic itself, where the limit is infinite.
    w : ndarray, shape (smax, n)
        w[s - 1] = mean of e^{-i s psi}; 0 where nothing is observed. Real for even s, imaginary for odd s.

    Raises
    ------
    InputError
        If the precession is not much faster than the orbit, or the line of sight is unknown.

    Notes
    -----
    With c the cosine of the spin axis' colatitude, z = cos theta, precession angle alpha and boresight beta,
    c = -sin(alpha) cos(precession angle) has density 1/(pi sqrt(sin^2 alpha - c^2)), and z given c has density
    1/(pi sqrt(sin^2 beta sin^2 theta - (c - z cos beta)^2)). So the hits are an integral of the inverse square root
    of a quartic in c between its two middle roots; at given c and z, sin psi = (c - z cos beta)/(sin beta sin theta),
    and the two solutions psi, pi - psi leave cos(s psi) for even s, -i sin(s psi) for odd s. The substitution by a
    Jacobi elliptic function (Byrd & Friedman 1971, 254) turns the integrand into an analytic periodic function, for
    which the trapezoidal rule with 128 nodes converges exponentially up to the caustics, where two roots meet.
    Measured against adaptive quadrature: 1e-10 (tests/unit/test_scan_limit.py).
    """
    line = _line(model, line_of_sight)
    theta = np.atleast_1d(np.asarray(theta, dtype=np.float64))
    # At the poles the orientations are all equally frequent: take them as limits.
    theta = np.clip(theta, 1e-6, math.pi - 1e-6)
    sin_a = math.sin(math.radians(model.precession_angle_deg))
    beta = math.radians(line.boresight_angle_deg)
    lowest, highest = np.cos(theta + beta), np.cos(theta - beta)
    edges = np.stack([np.full_like(theta, -sin_a), np.full_like(theta, sin_a), lowest, highest])
    seen = np.maximum(edges[0], lowest) < np.minimum(edges[1], highest)
    if sin_a == 0.0:
        seen = (lowest < 0.0) & (highest > 0.0)
    density, w = np.zeros_like(theta), np.zeros((smax, theta.size), dtype=np.complex128)
    if seen.any():
        roots = np.sort(edges[:, seen], axis=0)
        total, cosine = _elliptic_nodes(roots)
        middle, half = 0.5 * (highest + lowest)[seen], 0.5 * (highest - lowest)[seen]
        sine = np.clip((cosine - middle) / half, -1.0, 1.0)
        density[seen] = 2.0 * total / math.pi**2
        psi = np.arcsin(sine)
        for s in range(1, smax + 1):
            value = np.cos(s * psi) if s % 2 == 0 else -1j * np.sin(s * psi)
            # Trapezoidal rule on [0, K]: the end points count half.
            value[0] *= 0.5
            value[-1] *= 0.5
            w[s - 1, seen] = value.sum(axis=0) / (_NODES - 1)
    return density, w


def caustics(model: ScanModel, line_of_sight: str | None = None) -> NDArray[np.float64]:
    """Ecliptic colatitudes in (0, pi), in radians and sorted, at which the limit of the hits is singular."""
    beta = math.radians(_line(model, line_of_sight).boresight_angle_deg)
    alpha = math.radians(model.precession_angle_deg)
    angles = []
    for gamma in (0.5 * math.pi - alpha, 0.5 * math.pi + alpha):
        angles += [abs(gamma - beta), min(gamma + beta, 2.0 * math.pi - gamma - beta)]
    return np.unique([angle for angle in angles if 1e-12 < angle < math.pi - 1e-12])


def limit_quadrature(
    model: ScanModel, line_of_sight: str | None = None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Nodes and weights for integrals over ecliptic colatitude of what has the limit's caustics.

    Returns
    -------
    theta, weights
        sum(weights * f(theta)) is the integral of f(theta) sin(theta) over 0..pi: a double-exponential rule
        (Takahasi & Mori 1974) between each pair of neighbouring caustics, whose weak singularities (logarithms and
        their inverses) it absorbs.
    """
    breaks = np.concatenate([[0.0], caustics(model, line_of_sight), [math.pi]])
    steps = np.linspace(-3.2, 3.2, 2 * _GRADED + 1)
    position = np.tanh(0.5 * math.pi * np.sinh(steps))
    weight = 0.5 * math.pi * np.cosh(steps) / np.cosh(0.5 * math.pi * np.sinh(steps)) ** 2 * (steps[1] - steps[0])
    middle, half = 0.5 * (breaks[1:] + breaks[:-1]), 0.5 * (breaks[1:] - breaks[:-1])
    theta = (middle[:, np.newaxis] + half[:, np.newaxis] * position).ravel()
    return theta, (half[:, np.newaxis] * weight).ravel() * np.sin(theta)


def limit_harmonics(
    model: ScanModel, smax: int, lmax: int, line_of_sight: str | None = None
) -> NDArray[np.complex128]:
    """Spin-weighted harmonic coefficients w_{s,L0} of the limit's moments.

    Parameters
    ----------
    model, smax, line_of_sight
        As in :func:`limit_moments`.
    lmax
        Largest L.

    Returns
    -------
    ndarray, shape (smax, lmax + 1)
        Element [s - 1, L] of w_s = sum_L w_{s,L0} (-s)Y_L0; 0 for L < s. The other M vanish.

    Notes
    -----
    (-s)Y_L0(theta) = (-1)^s sqrt((2L+1)/4pi (L-s)!/(L+s)!) P_L^s(cos theta) with the Condon-Shortley phase in P_L^s.
    """
    theta, weights = limit_quadrature(model, line_of_sight)
    _, w = limit_moments(model, theta, smax, line_of_sight)
    z = np.cos(theta)
    coefficients = np.zeros((smax, lmax + 1), dtype=np.complex128)
    for s in range(1, smax + 1):
        for degree, harmonic in _spin_harmonics(s, lmax, z, np.sin(theta)):
            coefficients[s - 1, degree] = 2.0 * math.pi * np.sum(weights * w[s - 1] * harmonic)
    return coefficients
