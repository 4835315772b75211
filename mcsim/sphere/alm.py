"""Harmonic coefficients in healpy's m-major order: a_00, a_10, ..., a_lmax0, a_11, a_21, ..."""

import math
from functools import lru_cache

import healpy
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mcsim.errors import InputError
from mcsim.support.arrays import numbers

REALITY = 1e-6  #: largest imaginary part of a_l0 over the largest coefficient: single precision leaves 1e-7


def size(lmax: int) -> int:
    """Return the number of coefficients with 0 <= m <= l <= lmax."""
    return (lmax + 1) * (lmax + 2) // 2


def lmax_of(count: int) -> int | None:
    """Return the lmax of ``count`` coefficients with 0 <= m <= l <= lmax; None if there is none."""
    lmax = (math.isqrt(8 * count + 1) - 3) // 2
    return lmax if lmax >= 0 and size(lmax) == count else None


def start(lmax: int, m: int) -> int:
    """Return the offset such that a_lm is at ``start(lmax, m) + l``."""
    return m * (2 * lmax + 1 - m) // 2


@lru_cache(maxsize=8)
def degrees(lmax: int) -> NDArray[np.int64]:
    """Return the degree l of every coefficient, shape (size(lmax),), read-only."""
    ell = np.concatenate([np.arange(m, lmax + 1) for m in range(lmax + 1)])
    ell.setflags(write=False)
    return ell


@lru_cache(maxsize=8)
def orders(lmax: int) -> NDArray[np.int64]:
    """Return the order m of every coefficient, shape (size(lmax),), read-only."""
    m = np.repeat(np.arange(lmax + 1), np.arange(lmax + 1, 0, -1))
    m.setflags(write=False)
    return m


def multiplicity(lmax: int) -> NDArray[np.float64]:
    """Return how often every coefficient counts in a sum over all m: 1 at m = 0, else 2, shape (size(lmax),)."""
    return np.where(orders(lmax) == 0, 1.0, 2.0)


def multiply(alm: NDArray[np.complex128], factor: NDArray, lmax: int) -> NDArray[np.complex128]:
    """Return f_l a_lm for a factor f_l of shape (>= lmax + 1,), real or complex; InputError for other sizes."""
    _check_size(alm, lmax)
    if np.ndim(factor) != 1 or len(factor) <= lmax:
        raise InputError(f"the factor f_l has shape {np.shape(factor)}, but lmax = {lmax} needs (>= {lmax + 1},).")
    return alm * factor[degrees(lmax)]


def power(alm: NDArray[np.complex128], lmax: int) -> NDArray[np.float64]:
    """Return the sum of |a_lm|^2 over all m of every degree, shape (lmax + 1,); InputError for other sizes."""
    _check_size(alm, lmax)
    return np.asarray(np.bincount(degrees(lmax), multiplicity(lmax) * np.abs(alm) ** 2, lmax + 1), dtype=np.float64)


def resize(alm: NDArray[np.complex128], lmax: int, new_lmax: int) -> NDArray[np.complex128]:
    """Return the coefficients cut or zero-padded to ``new_lmax``; raise InputError if they are not of ``lmax``."""
    _check_size(alm, lmax)
    return np.asarray(healpy.resize_alm(alm, lmax, lmax, new_lmax, new_lmax), dtype=np.complex128)


def whole(given: ArrayLike, name: str) -> tuple[NDArray[np.complex128], int]:
    """Return given coefficients and their lmax; ``name`` names them in messages.

    Raise InputError if they are not complex, not those of a real map with every m up to lmax, or not finite.
    """
    alm = numbers(given, name)
    lmax = lmax_of(alm.size) if alm.ndim == 1 and np.iscomplexobj(alm) else None
    if lmax is None:
        raise InputError(
            f"{name} is {alm.dtype} of shape {alm.shape}, which is no map with every m up to lmax; give "
            "(lmax + 1)(lmax + 2)/2 complex coefficients in healpy's order."
        )
    if not np.all(np.isfinite(alm)):
        raise InputError(f"{name} has values that are not finite; give the coefficients of a whole map.")
    check_order(alm, lmax, name)
    return alm.astype(np.complex128), lmax


def check_order(alm: NDArray, lmax: int, name: str) -> None:
    """Raise InputError if a_l0 are complex: those of real maps are real, so the order is not healpy's."""
    if np.abs(alm[: lmax + 1].imag).max() > REALITY * np.abs(alm).max():
        raise InputError(f"{name} has complex a_l0, where a real sky has real ones; give healpy's m-major order.")


def _check_size(alm: NDArray[np.complex128], lmax: int) -> None:
    if np.shape(alm) != (size(lmax),):
        raise InputError(f"the coefficients have shape {np.shape(alm)}, but lmax = {lmax} needs ({size(lmax)},).")
