"""Harmonic coefficients of beams, shape (mmax + 1, lmax + 1): their limits, their power, and where to cut them in m."""

import numpy as np
from numpy.typing import NDArray

from mcsim.errors import InputError
from mcsim.sphere import alm as alm_

MMAX_TOLERANCE = 4e-4  #: largest fraction of a beam's power that :func:`choose_mmax` leaves beyond m_max
LARGEST = 32768  #: highest degree that a run may have
CIRCULAR_POWER = 1e-20  #: fraction of a beam's power below which what is not m = 0 is round-off, and the beam circular


def check_lmax(lmax: int) -> None:
    """Raise InputError unless ``lmax`` is a degree of a beam."""
    if isinstance(lmax, bool) or not isinstance(lmax, int | np.integer) or not 1 <= lmax <= LARGEST:
        raise InputError(f"lmax = {lmax!r} of a beam must be a whole number from 1 to {LARGEST}")


def check_mmax(mmax: int, lmax: int) -> None:
    """Raise InputError for an order that no coefficient up to ``lmax`` has."""
    if not isinstance(mmax, int | np.integer) or not 0 <= mmax <= lmax:
        raise InputError(
            f"mmax = {mmax} of a beam must be whole and lie between 0 and its lmax = {lmax}: lower mmax or raise lmax"
        )


def power_by_order(blm: NDArray[np.complex128]) -> NDArray[np.float64]:
    """Return the sum over l of |b_lm|^2, both signs of m together, shape (mmax + 1,)."""
    power: NDArray[np.float64] = np.sum(np.abs(blm) ** 2, axis=1)
    power[1:] *= 2
    return power


def cut(blm: NDArray[np.complex128], lmax: int | None, origin: str) -> NDArray[np.complex128]:
    """Return coefficients up to ``lmax`` (None: all); InputError, which names their origin, if they stop before it."""
    own = blm.shape[1] - 1
    lmax = own if lmax is None else lmax
    check_lmax(lmax)
    if lmax > own:
        raise InputError(
            f"{origin} stops at lmax = {own}, below the lmax = {lmax} asked for: lower lmax or give more coefficients"
        )
    return blm[: lmax + 1, : lmax + 1]


def unpacked(packed: NDArray, lmax: int, mmax: int) -> NDArray[np.complex128]:
    """Return coefficients in healpy's m-major order, with m up to ``mmax``, as [m, l]."""
    blm = np.zeros((mmax + 1, lmax + 1), dtype=np.complex128)
    for m in range(mmax + 1):
        start = alm_.start(lmax, m)
        blm[m, m:] = packed[start + m : start + lmax + 1]
    return blm


def choose_mmax(blm: NDArray[np.complex128]) -> int:
    """Choose the order above which a beam may be cut: 0 if it is circular to round-off, else 2 or more.

    It is the smallest that neglects no more than the fraction MMAX_TOLERANCE of the power over the degrees of ``blm``,
    shape (mmax + 1, lmax + 1), which has a larger order than can matter.

    Notes
    -----
    Never 1, nor 0 for a beam that is not circular: m = 2 may hold less than the tolerance and still be all of
    A^{20}. Orders that differ by 2 feed A^{20} in pairs, so that the leading neglected effect is b_l4 b_l2 over
    b_l2 b_l0. At the default, and lmax = 1024, the WMAP-7 beam maps V2, W1 and W4 get mmax = 4. On the same skies under
    parallel transport (mmax = 4 against 10, bins of 50 in l) that left out at most 0.5 uK^2 of a binned A^{20}_ll that
    reaches 269 uK^2 for V2, and 0.9 of 476 uK^2 for W1 (0.2 % of the largest), where mmax = 2 leaves out 2.7 and
    5.2 uK^2 (1 %). What is studied at L > 2 may need more: pass mmax then.
    """
    power = power_by_order(blm)
    if power[1:].sum() <= CIRCULAR_POWER * power.sum():
        return 0
    beyond = np.append(np.cumsum(power[::-1])[::-1][1:], 0.0) / power.sum()
    smallest = int(np.argmax(beyond <= MMAX_TOLERANCE))
    return min(max(2, smallest), len(power) - 1)
