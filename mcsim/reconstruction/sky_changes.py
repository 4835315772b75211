"""What small motions and powers make of the coefficients of a sky: turns, boosts, squares and cubes."""

import ducc0
import numpy as np

from mcsim.sphere import alm as alm_
from mcsim.systematics.base import Alm
from mcsim.systematics.product import multiplied


def rotations(alm: Alm, lmax: int) -> tuple[Alm, Alm, Alm]:
    """Return the changes of a map when it is turned about x, y and z, per radian.

    Notes
    -----
    T(n) goes to T(n - omega x n): a change of -i omega . L a, with L_z a_lm = m a_lm and (L_+- a)_lm =
    sqrt(l (l + 1) - m (m -+ 1)) a_{l, m -+ 1}.
    """
    degree, order = alm_.degrees(lmax).astype(float), alm_.orders(lmax)
    up, down = np.zeros_like(alm), np.zeros_like(alm)
    for m in range(lmax + 1):
        here = slice(alm_.start(lmax, m) + m, alm_.start(lmax, m) + lmax + 1)
        if m:
            below = alm[alm_.start(lmax, m - 1) + m : alm_.start(lmax, m - 1) + lmax + 1]
        else:  # a_{l,-1} = -conj(a_l1)
            below = np.append(0.0, -np.conj(alm[alm_.start(lmax, 1) + 1 : alm_.start(lmax, 1) + lmax + 1]))
        ell = degree[here]
        up[here] = np.sqrt(np.maximum(ell * (ell + 1) - m * (m - 1), 0.0)) * below
        above = np.zeros(len(ell), dtype=np.complex128)
        if m < lmax:
            above[1:] = alm[alm_.start(lmax, m + 1) + m + 1 : alm_.start(lmax, m + 1) + lmax + 1]
        down[here] = np.sqrt(np.maximum(ell * (ell + 1) - m * (m + 1), 0.0)) * above
    return -0.5j * (up + down), -0.5 * (up - down), -1j * order * alm


def boosts(alm: Alm, lmax: int) -> list[Alm]:
    """Return the changes of a sky by a motion along x, y and z, per unit of velocity.

    Notes
    -----
    f T - grad f . grad T with f = axis . n (:class:`mcsim.systematics.sky.Boost`) is (L f T - f L T)/2, L = l (l + 1):
    f takes l to l + 1 and l - 1, where L differs by 2 (l + 1) and -2 l.
    """
    ell = np.arange(lmax + 1.0)
    laplace = ell * (ell + 1.0)
    scaled, found = alm_.multiply(alm, laplace, lmax), []
    for axis in range(3):
        first, second = (multiplied(one, lmax, lambda *n, k=axis: n[k], 1) for one in (alm, scaled))
        found.append(0.5 * (alm_.multiply(first, laplace, lmax) - second))
    return found


def raised(alm: Alm, lmax: int, power: int) -> Alm:
    """Return the coefficients, up to ``lmax``, of a power of a map, on Gauss-Legendre rings that hold it."""
    options = {"lmax": lmax, "spin": 0, "geometry": "GL", "nthreads": 1}
    rings = ((power + 1) * lmax) // 2 + 2
    values = ducc0.sht.synthesis_2d(alm=alm[None], ntheta=rings, nphi=2 * rings, **options)
    return np.asarray(ducc0.sht.analysis_2d(map=values**power, **options))[0]
