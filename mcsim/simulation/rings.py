r"""Surveys whose orientation moments depend on colatitude alone: rings with exact quadrature instead of pixels.

Where w_s = w_s(theta), every azimuthal order m of the sky goes its own way, and no map is needed: the beam's order s
adds to the coefficients a_lm of the map

    2 int [Re w_s S_s]_m lambda_lm 2 pi sin(theta) dtheta,   Y_lm = lambda_lm e^{i m phi},

[.]_m the Fourier coefficient in azimuth. sin^s(theta) S_s is a sum of ordinary harmonics up to degree l + s, so each s
takes one spin-0 Legendre transform to the rings and one back, and no Fourier transform. The integrand is w_s times a
polynomial of known degree in cos(theta) (for odd s, and sin(theta)): rules for the weight w_s make the sum exact.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import ducc0
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh_tridiagonal

from mcsim.errors import InputError
from mcsim.instrument.scan import ScanModel
from mcsim.instrument.scan.limit import caustics, graded_rule, limit_moments
from mcsim.simulation.convolve import Response
from mcsim.sphere import alm as alm_
from mcsim.sphere.checks import check_alm, check_angle
from mcsim.support.arrays import Alm, Vector
from mcsim.support.compiled import njit

_ROUND_OFF = 1e8  #: loss of digits that the division by sin^s(theta) on the ring next to the pole may cost


_FEW = 3e8  #: points times squared nodes up to which a rule is built by Lanczos steps: about a second

_MISSED = 1e-6
"""Error of an integral over that of one from which on the recurrence point by point is not good enough."""

_CHECKED = 64  #: cosines of multiples of the colatitude whose integrals tell that error


@dataclass(frozen=True)
class Rings:
    """Rings that integrate over the sphere what stands beside one moment.

    w_s is ``phase`` times a real number everywhere. ``theta`` are colatitudes, shape (ring,), and sum(weight f(theta))
    is the integral of w_s / phase times f over the sphere.
    """

    s: int
    phase: complex
    theta: Vector
    weight: Vector


def parallel_transport_rings(psi0: float, orders: Iterable[int], degree: int) -> tuple[Rings, ...]:
    """Return the rings for w_s = e^{-i s psi0} everywhere; see :func:`limit_rings`."""
    check_angle(psi0, "psi0")
    moments = {s: np.exp(-1j * s * psi0) for s in orders}
    return _rings(lambda theta: {s: np.full(theta.size, w) for s, w in moments.items()}, np.empty(0), degree)


def limit_rings(model: ScanModel, orders: Iterable[int], degree: int) -> tuple[Rings, ...]:
    """Return the rings for the exact long-time limit of a scan model, in ecliptic coordinates.

    ``orders`` are those s >= 1 that the beam has, ``degree`` is the highest degree of the sky plus that of the
    analysis. InputError if the survey has no such limit, default lines of sight at different angles, or leaves a part
    of the sky out.

    Notes
    -----
    The integrals are first sums over the many nodes of a double-exponential rule between the caustics. Where w_s has
    one sign, the Gauss rule of the weight w_s says the same with degree/2 + 1 rings, from its three-term recurrence:
    by Lanczos steps, or, where these are too many and its round-off stays below 1e-6, point by point (Gragg & Harwood
    1984, Numer. Math. 44, 317). Where it changes sign, as it does about every caustic, each sign has rules of its own,
    over its intervals or altogether, whichever takes fewer rings: 1251 for WMAP, s = 2 and degree 2048. Against
    brute-force spin transforms: better than 1e-5 of what the beam adds, 1e-11 for parallel transport
    (tests/unit/test_rings.py).
    """
    orders = tuple(orders)
    if len({line.boresight_angle_deg for line in model.select()}) > 1:
        raise InputError(
            f"scan model {model.name!r} has the lines of sight {', '.join(model.default_lines)} at different angles, "
            'but a grid of rings takes one; choose it with scan.line_of_sight, or set map.grid = "healpix".'
        )

    def moments(theta: Vector) -> dict[int, Alm]:
        density, w = limit_moments(model, theta, max(orders, default=1))
        if not density.all():
            raise InputError(
                f"scan model {model.name!r} leaves a part of the sky out, which rings cannot weight; set map.grid = "
                '"healpix".'
            )
        return {s: w[s - 1] for s in orders}

    return _rings(moments, caustics(model), degree)


def noncircular_alm(alm: Alm, response: Response, rings: Iterable[Rings], lmax: int, nthreads: int = 1) -> Alm:
    """Return a_lm up to ``lmax`` of 2 Re sum_{s > 0} w_s S_s: what the non-circular part of the beam adds under a scan.

    The sky, uK, must be of the response's lmax and ``lmax`` no larger; the rings are those of the sum of the two.
    """
    check_alm(alm, response.lmax, "the sky")
    if lmax > response.lmax:
        raise InputError(f"lmax = {lmax} is above that of the response, {response.lmax}; lower it.")
    total = np.zeros(alm_.size(lmax), dtype=np.complex128)
    for each in rings:
        if each.s > response.mmax or not response.factors[each.s].any():
            continue
        legendre = _real_part(alm, each.phase * response.factors[each.s], each.s, each.theta, nthreads)
        legendre *= 2.0 * each.weight[:, np.newaxis]
        total += ducc0.sht.leg2alm(
            leg=legendre[np.newaxis, :, : lmax + 1], lmax=lmax, theta=each.theta, spin=0, nthreads=nthreads
        )[0]
    return total


def _real_part(alm: Alm, factor: Alm, s: int, theta: Vector, nthreads: int) -> NDArray[np.complex128]:
    """Return the fourier coefficients in azimuth of Re S_s on rings, shape (ring, lmax + 1)."""
    lmax = factor.size - 1
    if theta.min() ** (1 - s) > _ROUND_OFF:
        fields = np.stack([alm_.multiply(alm, -factor.real, lmax), alm_.multiply(alm, -factor.imag, lmax)])
        spin = ducc0.sht.alm2leg(alm=fields, lmax=lmax, theta=theta, spin=s, nthreads=nthreads)
        return np.asarray(spin)[0]
    m = np.arange(lmax + 1)
    length = lmax + s + 1 - m
    start = np.cumsum(length) - length
    scalar = np.empty(length.sum(), dtype=np.complex128)
    norm = np.zeros(lmax + 1)
    # sqrt((l - s)!/(l + s)!)
    norm[s:] = np.prod([1.0 / np.sqrt(m[s:] + k) for k in range(1 - s, s + 1)], axis=0)
    _times_sine_power(alm, norm * factor.real, norm * factor.imag, s, start, scalar)
    legendre = ducc0.sht.alm2leg(
        alm=scalar[np.newaxis],
        lmax=lmax + s,
        theta=theta,
        spin=0,
        mval=m.astype(np.uint64),
        mstart=(start - m).astype(np.uint64),
        nthreads=nthreads,
    )
    return np.asarray(legendre)[0] / np.sin(theta)[:, np.newaxis] ** s


@njit(nogil=True)
def _times_sine_power(alm, real, imag, s, start, result):  # type: ignore[no-untyped-def]
    """Return the coefficients of Re(sin^s(theta) S_s) by m: rows m..lmax + s, at start[m].

    With h_k = sin^k (spin-raised k times), h_{k+1} = -(sin d/dtheta - 2 k cos - m) h_k, which takes the degree l to
    l - 1, l and l + 1. The sky is real, so the real part keeps what is even in m of the factor's real part and what
    is odd in m of its imaginary part.
    """
    lmax = real.size - 1
    even, odd = np.empty(lmax + s + 2, dtype=np.complex128), np.empty(lmax + s + 2, dtype=np.complex128)
    cosine = np.zeros(lmax + s + 3)
    first = 0
    for m in range(lmax + 1):
        even[m:] = 0.0
        odd[m:] = 0.0
        for ell in range(m, lmax + 1):
            value = alm[first + ell - m]
            even[ell] = real[ell] * value
            odd[ell] = 1j * imag[ell] * value
        first += lmax + 1 - m
        cosine[m] = 0.0
        for ell in range(m + 1, lmax + s + 2):
            cosine[ell] = np.sqrt((ell - m) * (ell + m) / (4.0 * ell * ell - 1.0))
        for k in range(s):
            even_below, odd_below = 0.0j, 0.0j
            for ell in range(m, lmax + k + 2):
                up, down = (2 * k + 1 - ell) * cosine[ell], (2 * k + 2 + ell) * cosine[ell + 1]
                e, o = even[ell], odd[ell]
                even[ell] = up * even_below + m * o + down * even[ell + 1]
                odd[ell] = up * odd_below + m * e + down * odd[ell + 1]
                even_below, odd_below = e, o
        for ell in range(m, lmax + s + 1):  # a loop: numba takes seconds to compile the assignment of a slice
            result[start[m] + ell - m] = even[ell]


def _rings(moments: Callable[[Vector], dict[int, Alm]], breaks: Vector, degree: int) -> tuple[Rings, ...]:
    """Return rules up to a degree for moments that are smooth between the breaks."""
    theta, weight = graded_rule(breaks, lambda half: int(100 + degree * half))
    found = []
    for s, w in moments(theta).items():
        largest = w[np.argmax(np.abs(w))]
        if largest == 0.0:
            continue
        phase = complex(largest / abs(largest))
        # By symmetry the limit is real or imaginary; so one phase makes w_s real. The integrand is a polynomial in
        # cos(theta) for even s, and one over sin(theta) for odd s.
        sine = np.sin(theta) ** (s % 2)
        nodes, weights = _signed_rule(theta, weight * sine * (w / phase).real, degree)
        found.append(Rings(s, phase, nodes, weights / np.sin(nodes) ** (s % 2)))
    return tuple(found)


def _signed_rule(theta: Vector, measure: Vector, degree: int) -> tuple[Vector, Vector]:
    """Return few nodes, and weights, that integrate polynomials in cos(theta) like the many of ``measure``."""
    counts = np.abs(measure) > 1e-17 * np.abs(measure).sum()
    x, theta, measure = np.cos(theta[counts]), theta[counts], measure[counts]
    if np.abs(x + x[::-1]).max() < 1e-12 and np.abs(measure - measure[::-1]).max() < 1e-10 * np.abs(measure).max():
        # Rings at exactly opposite latitudes share their Legendre functions.
        x, measure = 0.5 * (x - x[::-1]), 0.5 * (measure + measure[::-1])
    rules = []
    for sign in (1.0, -1.0):
        of_sign = np.flatnonzero(sign * measure > 0.0)
        if of_sign.size == 0:
            continue
        runs = np.split(of_sign, np.flatnonzero(np.diff(of_sign) > 1) + 1)
        enough = [min(run.size, _nodes(theta[run[-1]] - theta[run[0]], degree)) for run in runs]
        if sum(enough) > degree // 2 + 1:
            runs, enough = [of_sign], [min(of_sign.size, degree // 2 + 1)]
        for run, count in zip(runs, enough, strict=True):
            nodes, weights = _gauss(x[run], sign * measure[run], count)
            rules.append((nodes, sign * weights))
    nodes, weights = (np.concatenate(parts) for parts in zip(*rules, strict=True))
    order = np.argsort(nodes)
    return np.clip(nodes[order], 1e-9, np.pi - 1e-9), weights[order]


def _nodes(length: float, degree: int) -> int:
    """Return Gauss nodes that integrate polynomials of a degree in cos(theta) to round-off over an interval of theta.

    A node is needed for every two thirds of a wavelength at its middle, and some for the last digits.
    """
    return min(degree // 2 + 1, int(0.25 * degree * length + 4.0 * (degree * length) ** (1.0 / 3.0)) + 12)


def _gauss(x: Vector, weight: Vector, count: int) -> tuple[Vector, Vector]:
    """Return ``count`` Gauss nodes, as colatitudes, for a sum of points with positive weights in x = cos(theta)."""
    if x[0] + x[-1] < 0.0:
        # The same steps as for its mirror image, so that round-off is the same as well.
        nodes, weights = _gauss(-x[::-1], weight[::-1], count)
        return np.pi - nodes, weights
    if x.size * count**2 >= _FEW:
        theta, (nodes, weights) = np.arccos(x), _rule(x, weight, *_recurrence(x, weight, count))
        multiples = np.linspace(0.0, 2.0 * count - 1.0, _CHECKED).astype(int).tolist()
        missed = [weight @ np.cos(k * theta) - weights @ np.cos(k * nodes) for k in multiples]
        if np.abs(missed).max() < _MISSED * weight.sum():
            return nodes, weights
    return _rule(x, weight, *_lanczos(x, weight, count))


def _rule(x: Vector, weight: Vector, diagonal: Vector, squared: Vector) -> tuple[Vector, Vector]:
    """Return the Gauss nodes, as colatitudes, and weights of a three-term recurrence."""
    if np.array_equal(x, -x[::-1]) and np.array_equal(weight, weight[::-1]):
        diagonal[:] = 0.0
    nodes, vectors = eigh_tridiagonal(diagonal, np.sqrt(squared[1:]))
    return np.arccos(np.clip(nodes, -1.0, 1.0)), squared[0] * vectors[0] ** 2


def _lanczos(x: Vector, weight: Vector, count: int) -> tuple[Vector, Vector]:
    """Return what :func:`_recurrence` does, free of its round-off, at a cost of count^2 points."""
    basis = np.zeros((count, x.size))
    diagonal, squared = np.empty(count), np.empty(count)
    vector = np.sqrt(weight)
    for k in range(count):
        size = np.sqrt(vector @ vector)
        squared[k], basis[k] = size**2, vector / size
        vector = x * basis[k]
        diagonal[k] = vector @ basis[k]
        for _ in range(2):
            vector = vector - (basis[: k + 1] @ vector) @ basis[: k + 1]
    return diagonal, squared


@njit(nogil=True)
def _recurrence(x, weight, count):  # type: ignore[no-untyped-def]
    """Return the coefficients a_k, b_k of the monic orthogonal polynomials of a sum of points, added one by one."""
    diagonal, squared = np.zeros(count), np.zeros(count)
    for point in range(x.size):
        mass, cosine, sine, shift = weight[point], 1.0, 0.0, 0.0
        for k in range(min(point + 1, count)):
            total = squared[k] + mass
            scaled = cosine * total
            before = sine
            cosine, sine = (squared[k] / total, mass / total) if total > 0.0 else (1.0, 0.0)
            moved = sine * (diagonal[k] - x[point]) - cosine * shift if k < point else -x[point]
            if k < point:
                diagonal[k] -= moved - shift
            else:
                diagonal[k] = x[point]
            shift = moved
            mass = shift * shift / sine if sine > 0.0 else before * squared[k]
            squared[k] = scaled
    return diagonal, squared
