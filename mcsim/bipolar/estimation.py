r"""The BipoSH estimator: from two sets of a_lm to A^{LM}_{l1 l2} for all L <= L_max, M >= 0 and |l1 - l2| <= L.

Stored at ell = l2 with d = l2 - l1, in the Hajian-Souradeep normalisation,

    A^{LM}_{l1 l2} = sum_{m1 m2} a_{l1 m1} conj(b_{l2 m2}) (-1)^{m2} C^{LM}_{l1 m1 l2 -m2}   (paper, eq. gen-BipoSH).
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from mcsim.bipolar.modes import Mode, existing, modes
from mcsim.errors import InputError
from mcsim.sphere.checks import check_alm, check_finite, check_whole
from mcsim.sphere.clebsch import Band, band
from mcsim.support.arrays import Alm, Cl
from mcsim.support.compiled import njit


@dataclass(frozen=True)
class Estimator:
    """Tables that the estimator needs besides the a_lm; :func:`estimator` makes them once per run."""

    lmax: int
    modes: tuple[Mode, ...]
    bands: tuple[Band, ...]

    @cached_property
    def rows(self) -> tuple[tuple[tuple[int, Mode, slice], ...], ...]:
        """Return the modes of every band, each with its row in a result and the ell at which it exists."""
        found: list[tuple[tuple[int, Mode, slice], ...]] = []
        for b in self.bands:
            members = [(row, mode) for row, mode in enumerate(self.modes) if (mode.M, mode.d) == (b.M, b.d)]
            found.append(tuple((row, mode, _range(existing(mode.L, mode.d, self.lmax))) for row, mode in members))
        return tuple(found)


def _range(exists: NDArray[np.bool_]) -> slice:
    """Return the ell that are true, of which none is false between two others."""
    where = np.flatnonzero(exists)
    return slice(int(where[0]), int(where[-1]) + 1) if where.size else slice(0)


@lru_cache(maxsize=4, typed=True)
def estimator(L_max: int, lmax: int, both_orders: bool = False) -> Estimator:
    """Return the Clebsch-Gordan tables for all modes up to L_max at l1, l2 <= lmax.

    Raise InputError if L_max is negative or exceeds lmax.
    """
    check_whole(lmax, "lmax")
    check_whole(L_max, "L_max")
    if not 0 <= L_max <= lmax:
        raise InputError(f"L_max = {L_max} is outside 0 ... {lmax} (the analysis lmax); choose a smaller L_max.")
    wanted = modes(L_max, both_orders)
    pairs = sorted({(mode.M, mode.d) for mode in wanted})
    return Estimator(lmax, wanted, tuple(band(L_max, M, d, lmax) for M, d in pairs))


def estimate(
    tables: Estimator, alm_x: NDArray[np.complex128], alm_y: NDArray[np.complex128] | None = None
) -> NDArray[np.complex128]:
    """Return A^{LM}_{l2 - d, l2} of one map, or of the ordered pair of maps that carry l1 and l2.

    The coefficients of the maps are in m-major order, shape (alm.size(lmax),). The result has shape (modes, lmax + 1)
    and the square of their unit; NaN where a coefficient does not exist (l1 < 0, l1 > lmax, the triangle of l1, l2, L),
    and for one map in the modes that repeat others. Raise InputError if the coefficients are not complex, not finite,
    or not of the tables' lmax.

    Notes
    -----
    Only m2 >= 0 is summed for M = 0; the other half follows from the reality of the maps. Agrees with an explicit sum
    over exact Clebsch-Gordan coefficients to 1e-13 (``tests/unit/test_biposh.py``).
    """
    for name, alm in (("alm_x", alm_x), ("alm_y", alm_y)):
        if alm is not None:
            check_alm(alm, tables.lmax, name)
            check_finite(alm, name)
    auto = alm_y is None
    x = _parts(alm_x)
    y = x if alm_y is None else _parts(alm_y)
    result = np.full((len(tables.modes), tables.lmax + 1), complex(np.nan, np.nan))
    for b, rows in zip(tables.bands, tables.rows, strict=True):
        if auto and b.d < 0:
            continue
        total = np.zeros((b.L_max - b.L_min + 1, 2, tables.lmax + 1))
        _accumulate(x, y, tables.lmax, b, total)
        for row, mode, exists in rows:
            if auto and not mode.in_auto:
                continue
            real, imag = total[mode.L - b.L_min, :, exists]
            if mode.M == 0:
                # The sum counts m > 0 twice; of m and -m together only this part remains.
                real, imag = (real, 0.0 * imag) if mode.parity == "even" else (0.0 * real, imag)
            result[row, exists] = real + 1j * imag
    return result


def power_spectrum(alm_x: NDArray[np.complex128], alm_y: NDArray[np.complex128], lmax: int) -> NDArray[np.float64]:
    """Return C_l = sum_m a_lm conj(b_lm) / (2 l + 1) of two real maps, shape (lmax + 1,).

    Raise InputError if the coefficients are not complex or not of ``lmax``.
    """
    check_alm(alm_x, lmax, "alm_x")
    check_alm(alm_y, lmax, "alm_y")
    return by_degree(alm_x, alm_y, lmax) / (2.0 * np.arange(lmax + 1) + 1.0)


def by_degree(a: Alm, b: Alm, lmax: int) -> Cl:
    """Return the sum over all m of a_lm conj(b_lm) of two real fields, shape (lmax + 1,); sizes are not checked."""
    found = np.zeros(lmax + 1)
    _add_by_degree(a, b, found)
    return found


@njit(nogil=True)
def _add_by_degree(a, b, found):  # type: ignore[no-untyped-def]
    """Add the products of all orders m, twice for m > 0, in one pass over memory."""
    place = 0
    for m in range(found.size):
        twice = 2.0 if m else 1.0
        for ell in range(m, found.size):
            product = a[place].real * b[place].real + a[place].imag * b[place].imag
            found[ell] += twice * product
            place += 1


def _parts(alm: NDArray[np.complex128]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    return np.ascontiguousarray(alm.real), np.ascontiguousarray(alm.imag)


@njit(nogil=True)
def _accumulate(x, y, lmax, tables, total):  # type: ignore[no-untyped-def]
    """Add sum_m2 G_L P to total[L - L_min, (real, imaginary), l2]; ``x`` and ``y`` are (real, imaginary) of a_lm."""
    M, d, _, _, norm, rising_a, rising_b, shift_a, shift_b, constant, slope, previous = tables
    (ar, ai), (br, bi) = x, y
    rows = total.shape[0]
    work = np.empty((4, lmax + 1))
    for m2 in range(0 if M == 0 else -lmax, lmax + 1):
        m1 = m2 + M
        p, q = abs(m1), abs(m2)
        first = max(q, p + d)
        stop = min(lmax, lmax + d) + 1
        if stop <= first:
            continue
        ia = p * (2 * lmax + 1 - p) // 2 - d
        ib = q * (2 * lmax + 1 - q) // 2
        # a_{l1 m1} conj(b_{l2 m2}) from m >= 0 by a_{l -m} = (-1)^m conj(a_lm).
        sign_a, sign_b, sign = 1.0, -1.0, 1.0
        if m2 < 0:
            sign_b = 1.0
            sign = 1.0 if q % 2 == 0 else -1.0
            if m1 < 0:
                sign_a = -1.0
                sign = 1.0 if M % 2 == 0 else -1.0
        elif M == 0 and m2 > 0:
            sign = 2.0
        real, imag, g, before = work[:, : stop - first]
        here_a, here_b = slice(ia + first, ia + stop), slice(ib + first, ib + stop)
        signs = (sign, sign * sign_a, sign_b)
        _products((ar[here_a], ai[here_a]), (br[here_b], bi[here_b]), signs, real, imag)
        a, b = first - m1 + shift_a, first + m1 + shift_b
        _bottom(norm[first:stop], rising_a[a : a + stop - first], rising_b[b : b + stop - first], g, before)
        for row in range(rows):
            _add(g, real, imag, total[row, 0, first:stop], total[row, 1, first:stop])
            if row + 1 < rows:
                _step(constant[row, first:stop], slope[row, first:stop], previous[row, first:stop], m1, g, before)


# The inner loops run along l2 over slices of unit stride, so that the compiler turns them into vector instructions.


@njit(nogil=True)
def _products(first, second, signs, real, imag):  # type: ignore[no-untyped-def]
    """Compute (sign_x x + i sign_y y)(u + i sign_v v) of (x, y) and (u, v)."""
    (x, y), (u, v) = first, second
    sign_x, sign_y, sign_v = signs
    for i in range(real.size):
        a, b, c = sign_x * x[i], sign_y * y[i], sign_v * v[i]
        real[i] = a * u[i] - b * c
        imag[i] = a * c + b * u[i]


@njit(nogil=True)
def _bottom(norm, rising_a, rising_b, g, before):  # type: ignore[no-untyped-def]
    """Set G at the smallest L, and zero below it."""
    for i in range(g.size):
        g[i] = norm[i] * rising_a[i] * rising_b[i]
        before[i] = 0.0


@njit(nogil=True)
def _add(g, real, imag, total_real, total_imag):  # type: ignore[no-untyped-def]
    for i in range(g.size):
        total_real[i] += g[i] * real[i]
        total_imag[i] += g[i] * imag[i]


@njit(nogil=True)
def _step(constant, slope, previous, m1, g, before):  # type: ignore[no-untyped-def]
    """Step G from L to L + 1."""
    for i in range(g.size):
        after = (constant[i] + slope[i] * m1) * g[i] + previous[i] * before[i]
        before[i] = g[i]
        g[i] = after
