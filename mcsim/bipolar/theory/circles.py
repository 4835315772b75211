"""Weights of pixels along great circles: how they correlate coefficients A^{LM}_{l1 l2} of each M and d.

Along the great circle around a pole u, from e_theta(u) on, a product of weights is f(u, gamma) = sum_n f_n(u) e^{i n
gamma}. f_n is a field of spin n: its harmonics are those of f times (-n)Y_K0(pi/2), but for a sign.
"""

from typing import NamedTuple

import ducc0
import numpy as np
from numpy.typing import NDArray
from scipy.special import binom, eval_jacobi

from mcsim.bipolar.modes import Indices
from mcsim.bipolar.theory.harmonics import spin_functions
from mcsim.sphere import alm as alm_


class Circles(NamedTuple):
    """Means of products of f_n over the poles of one colatitude, in units of <W_x W_y>^2.

    ``share``: the fraction of the sphere that each colatitude ``theta`` stands for, shape (n_theta,). ``autos``: f_n of
    W_x^2 times the conjugate one of W_y^2, shape (n, n_theta). ``cross``: f_{d+n} f_{d-n} of W_x W_y, shape (d, n,
    n_theta).
    """

    theta: NDArray[np.float64]
    share: NDArray[np.float64]
    autos: NDArray[np.float64]
    cross: NDArray[np.float64]

    def beside(self, mode: Indices, shift: int) -> tuple[float, float]:
        """Return what a mode (L, M, d) has in both terms of its variance beside the mean over M, at high l."""
        L, M, d = mode
        one, other = (little_d(L, M, order, self.theta) for order in (d, -d))
        first = self.share @ (((2 * L + 1) * one**2 - 1.0) * self.autos[shift])
        second = self.share @ (((2 * L + 1) * one * other - (d == 0)) * self.cross[abs(d), shift])
        return float(first), float(second)


def circles(
    products: tuple[NDArray[np.complex128], NDArray[np.complex128], NDArray[np.complex128]],
    unit: float,
    reach: int,
    d_max: int,
) -> Circles:
    """Return means up to n = ``reach`` and |d| = ``d_max``, from the harmonics of W_x^2, W_y^2 and W_x W_y.

    Their layout is that of :func:`mcsim.bipolar.theory.map_harmonics`; ``unit`` is <W_x W_y>^2.
    """
    own, other, both = products
    top = int(max(np.flatnonzero(np.abs(product).any(axis=1))[-1] for product in products))
    top = max(top, reach + d_max)  # a field of spin n has no degrees below n
    alike = own is other
    own, other, both = (_up_to(top, product) for product in (own, other, both))
    theta = ducc0.misc.GL_thetas(top + d_max + 1)
    share = ducc0.misc.GL_weights(top + d_max + 1, 1) / (4.0 * np.pi)
    first = _fields(own, top, reach, len(theta))
    second = first if alike else _fields(other, top, reach, len(theta))
    mixed = _fields(both, top, reach + d_max, len(theta))
    autos = np.mean((first * second.conj()).real, axis=-1)
    cross = np.empty((d_max + 1, reach + 1, len(theta)))
    for d in range(d_max + 1):
        for n in range(reach + 1):
            below = mixed[d - n] if n <= d else mixed[n - d].conj()
            cross[d, n] = np.mean((mixed[d + n] * below).real, axis=-1)
    return Circles(theta, share, autos / unit, cross / unit)


def _up_to(top: int, product: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Return harmonics of this layout with zeros up to a degree, if they end before it."""
    more = max(top + 1 - len(product), 0)
    return np.pad(product, ((0, more), (more, more)))


def _fields(product: NDArray[np.complex128], top: int, reach: int, rings: int) -> NDArray[np.complex128]:
    """Return f_n, n = 0..reach, of a product of weights, on rings of Gauss and Legendre, shape (n, ring, azimuth)."""
    L_max, azimuths = len(product) - 1, 2 * top + 1
    along = spin_functions(reach, top, np.array([0.5 * np.pi]))[..., 0]
    size = alm_.size(top)
    degree, order = np.concatenate([[(K, N) for K in range(N, top + 1)] for N in range(top + 1)]).T
    found = np.empty((reach + 1, rings, azimuths), dtype=np.complex128)
    for n in range(reach + 1):
        scale = np.sqrt(4.0 * np.pi / (2.0 * degree + 1.0)) * along[n, degree]
        coefficients = np.zeros((1 if n == 0 else 2, size), dtype=np.complex128)
        coefficients[0] = scale * product[degree, L_max + order]
        shape = {"lmax": top, "spin": n, "geometry": "GL", "ntheta": rings, "nphi": azimuths}
        parts = ducc0.sht.synthesis_2d(alm=coefficients, **shape)
        found[n] = parts[0] if n == 0 else -(parts[0] + 1j * parts[1])
    return found


def little_d(L: int, M: int, order: int, theta: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return Wigner's d^L_{M, order}(theta), |M| and |order| <= L, theta in radians, from Jacobi polynomials."""
    k = min(L + order, L - order, L + M, L - M)
    a, sign = abs(order - M), (-1.0) ** (order - M) if k in (L + order, L - M) and order < M else 1.0
    b = 2 * L - 2 * k - a
    norm = np.sqrt(binom(2 * L - k, k + a) / binom(k + b, b))
    return sign * norm * np.sin(0.5 * theta) ** a * np.cos(0.5 * theta) ** b * eval_jacobi(k, a, b, np.cos(theta))
