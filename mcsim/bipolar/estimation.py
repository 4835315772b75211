r"""The BipoSH estimator: from two sets of a_lm to A^{LM}_{l1 l2} for all L <= L_max, M >= 0 and |l1 - l2| <= L.

Stored at ell = l2 with d = l2 - l1, in the Hajian-Souradeep normalisation,

    A^{LM}_{l1 l2} = sum_{m1 m2} a_{l1 m1} conj(b_{l2 m2}) (-1)^{m2} C^{LM}_{l1 m1 l2 -m2}   (paper, eq. gen-BipoSH).
"""

from dataclasses import dataclass
from functools import lru_cache

import numba
import numpy as np
from numpy.typing import NDArray

from mcsim.errors import InputError
from mcsim.sphere import alm as alm_
from mcsim.sphere.checks import check_alm, check_finite, check_whole
from mcsim.sphere.clebsch import Band, band, evaluate


@dataclass(frozen=True, order=True)
class Mode:
    """One BipoSH spectrum: L, M >= 0 and d = l2 - l1."""

    L: int
    M: int
    d: int

    @property
    def name(self) -> str:
        """Index label, for example ``L2M0d0``."""
        return f"L{self.L}M{self.M}d{self.d}"

    @property
    def parity(self) -> str:
        """``even`` or ``odd``: that of l1 + l2 + L."""
        return "odd" if (self.d + self.L) % 2 else "even"

    @property
    def in_auto(self) -> bool:
        """Whether one map alone has this mode: d >= 0, and not the identically vanishing d = 0 of odd parity."""
        return self.d > 0 or (self.d == 0 and self.parity == "even")


def modes(L_max: int, both_orders: bool) -> tuple[Mode, ...]:
    """All modes up to L_max: of one map (0 <= d <= L), or of ordered pairs of maps (-L <= d <= L)."""
    every = (Mode(L, M, d) for L in range(L_max + 1) for M in range(L + 1) for d in range(-L, L + 1))
    return tuple(mode for mode in every if both_orders or mode.in_auto)


@dataclass(frozen=True)
class Estimator:
    """What the estimator needs besides the a_lm; made once per run by :func:`estimator`."""

    lmax: int
    modes: tuple[Mode, ...]
    bands: tuple[Band, ...]


@lru_cache(maxsize=4)
def estimator(L_max: int, lmax: int, both_orders: bool = False) -> Estimator:
    """Clebsch-Gordan tables for all modes up to L_max at l1, l2 <= lmax.

    Raises
    ------
    InputError
        If L_max is negative or exceeds lmax.
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
    """BipoSH coefficients of one map, or of an ordered pair of maps.

    Parameters
    ----------
    tables
        From :func:`estimator`.
    alm_x, alm_y
        Coefficients of the maps that carry l1 and l2, shape (alm.size(lmax),), m-major order; without ``alm_y`` both
        are ``alm_x``.

    Returns
    -------
    ndarray
        A^{LM}_{l2 - d, l2}, shape (modes, lmax + 1), in the square of the input's unit. NaN where the coefficient does
        not exist (l1 < 0, l1 > lmax, the triangle of l1, l2, L), and for one map in the modes that repeat others.

    Raises
    ------
    InputError
        If the coefficients are not complex, not finite, or not of the tables' lmax.

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
    ar, ai = _parts(alm_x)
    br, bi = (ar, ai) if alm_y is None else _parts(alm_y)
    result = np.full((len(tables.modes), tables.lmax + 1), complex(np.nan, np.nan))
    l2 = np.arange(tables.lmax + 1)
    for b in tables.bands:
        if auto and b.d < 0:
            continue
        total = np.zeros((b.L_max - b.L_min + 1, 2, tables.lmax + 1))
        _accumulate(
            ar, ai, br, bi, tables.lmax, b.M, b.d, b.norm, b.rising_a, b.rising_b, b.shift_a, b.shift_b,
            b.constant, b.slope, b.previous, total,
        )  # fmt: skip
        l1 = l2 - b.d
        for row, mode in enumerate(tables.modes):
            if (mode.M, mode.d) != (b.M, b.d) or (auto and not mode.in_auto):
                continue
            real, imag = total[mode.L - b.L_min]
            if mode.M == 0:
                # The sum holds m > 0 twice; of m and -m together only this part survives.
                real, imag = (real, 0.0 * imag) if mode.parity == "even" else (0.0 * real, imag)
            exists = (l1 >= 0) & (l1 <= tables.lmax) & (l1 + l2 >= mode.L)
            result[row, exists] = (real + 1j * imag)[exists]
    return result


def bennett_factor(mode: Mode, lmax: int) -> NDArray[np.float64]:
    """Factor from the Hajian-Souradeep to the Bennett (WMAP) normalisation at ell = l2, shape (lmax + 1,).

    sqrt(2L+1) / (sqrt((2 l1 + 1)(2 l2 + 1)) C^{L0}_{l1 0 l2 0}); NaN where the coefficient does not exist.

    Raises
    ------
    InputError
        For odd parity, where C^{L0}_{l1 0 l2 0} vanishes.
    """
    if mode.parity == "odd":
        raise InputError(
            f"Mode {mode.name} has odd parity, for which the Bennett normalisation does not exist; "
            "use the Hajian-Souradeep normalisation."
        )
    tables = band(mode.L, 0, mode.d, lmax)
    factor = np.full(lmax + 1, np.nan)
    for l2 in range(lmax + 1):
        l1 = l2 - mode.d
        if l1 >= 0 and l1 + l2 >= mode.L:
            clebsch = evaluate(tables, mode.L, l2, 0)
            factor[l2] = np.sqrt(2 * mode.L + 1) / (np.sqrt((2 * l1 + 1.0) * (2 * l2 + 1.0)) * clebsch)
    return factor


def power_spectrum(alm_x: NDArray[np.complex128], alm_y: NDArray[np.complex128], lmax: int) -> NDArray[np.float64]:
    """C_l = sum_m a_lm conj(b_lm) / (2 l + 1) of two real maps, shape (lmax + 1,); InputError for other sizes."""
    check_alm(alm_x, lmax, "alm_x")
    check_alm(alm_y, lmax, "alm_y")
    product = alm_x.real * alm_y.real + alm_x.imag * alm_y.imag
    product[lmax + 1 :] *= 2.0
    total = np.bincount(alm_.degrees(lmax), weights=product, minlength=lmax + 1)
    return total / (2.0 * np.arange(lmax + 1) + 1.0)


def _parts(alm: NDArray[np.complex128]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    return np.ascontiguousarray(alm.real), np.ascontiguousarray(alm.imag)


@numba.njit(cache=True, nogil=True)
def _accumulate(  # type: ignore[no-untyped-def]
    ar, ai, br, bi, lmax, M, d, norm, rising_a, rising_b, shift_a, shift_b, constant, slope, previous, total
):  # fmt: skip
    """Add sum_m2 G_L P to total[L - L_min, (real, imaginary), l2]."""
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
        _products(
            ar[ia + first : ia + stop], ai[ia + first : ia + stop], br[ib + first : ib + stop],
            bi[ib + first : ib + stop], sign, sign * sign_a, sign_b, real, imag,
        )  # fmt: skip
        a, b = first - m1 + shift_a, first + m1 + shift_b
        _bottom(norm[first:stop], rising_a[a : a + stop - first], rising_b[b : b + stop - first], g, before)
        for row in range(rows):
            _add(g, real, imag, total[row, 0, first:stop], total[row, 1, first:stop])
            if row + 1 < rows:
                _step(constant[row, first:stop], slope[row, first:stop], previous[row, first:stop], m1, g, before)


# The inner loops run along l2 over slices of unit stride, so that the compiler turns them into vector instructions.


@numba.njit(cache=True, nogil=True)
def _products(x, y, u, v, sign_x, sign_y, sign_v, real, imag):  # type: ignore[no-untyped-def]
    """(sign_x x + i sign_y y)(u + i sign_v v)."""
    for i in range(real.size):
        a, b, c = sign_x * x[i], sign_y * y[i], sign_v * v[i]
        real[i] = a * u[i] - b * c
        imag[i] = a * c + b * u[i]


@numba.njit(cache=True, nogil=True)
def _bottom(norm, rising_a, rising_b, g, before):  # type: ignore[no-untyped-def]
    """G at the smallest L, and zero below it."""
    for i in range(g.size):
        g[i] = norm[i] * rising_a[i] * rising_b[i]
        before[i] = 0.0


@numba.njit(cache=True, nogil=True)
def _add(g, real, imag, total_real, total_imag):  # type: ignore[no-untyped-def]
    for i in range(g.size):
        total_real[i] += g[i] * real[i]
        total_imag[i] += g[i] * imag[i]


@numba.njit(cache=True, nogil=True)
def _step(constant, slope, previous, m1, g, before):  # type: ignore[no-untyped-def]
    """From L to L + 1."""
    for i in range(g.size):
        after = (constant[i] + slope[i] * m1) * g[i] + previous[i] * before[i]
        before[i] = g[i]
        g[i] = after
