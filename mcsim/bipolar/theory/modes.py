"""Modes (L, M, d) of BipoSH spectra stored at ell = l2 with d = l2 - l1: which exist, and their two normalisations."""

from collections.abc import Iterable, Sequence
from functools import lru_cache

import ducc0
import numpy as np
from numpy.typing import NDArray

from mcsim.errors import InputError

Mode = tuple[int, int, int]


def check_modes(modes: Iterable[Mode]) -> None:
    """Raise InputError for a mode that no BipoSH has: L >= 0, |M| <= L and |d| <= L are needed."""
    for L, M, d in modes:
        if L < 0 or abs(M) > L or abs(d) > L:
            raise InputError(f"mode L={L}, M={M}, d={d} does not exist; |M| and |d| must not exceed L.")


def existing(L: int, d: int, lmax: int) -> NDArray[np.bool_]:
    """Whether A^{LM}_{l2-d, l2} exists for l2 = 0..lmax: 0 <= l1 <= lmax and |l1 - l2| <= L <= l1 + l2."""
    l2 = np.arange(lmax + 1)
    l1 = l2 - d
    return (l1 >= 0) & (l1 <= lmax) & (abs(d) <= L) & (l1 + l2 >= L)


@lru_cache(maxsize=256)
def spin_coupling(L: int, d: int, s: int, lmax: int) -> NDArray[np.float64]:
    """3j symbols (l1 L l2; 0 s -s) with l1 = l2 - d at l2 = 0..lmax, zero where they vanish; read-only."""
    symbols = np.zeros(lmax + 1)
    if abs(s) <= L and abs(d) <= L:
        for l2 in range(max(abs(s), d), lmax + 1):
            lowest, family = ducc0.misc.wigner3j_int(L, l2, s, -s)
            if 0 <= l2 - d - lowest < len(family):
                symbols[l2] = family[l2 - d - lowest]
    symbols.setflags(write=False)
    return symbols


def bennett_factor(L: int, d: int, lmax: int) -> NDArray[np.float64]:
    """Factor from the Hajian-Souradeep to the Bennett (WMAP) normalisation.

    Parameters
    ----------
    L, d
        Mode; M does not enter.
    lmax
        Highest l2.

    Returns
    -------
    ndarray
        sqrt(2L+1) / (sqrt((2 l1+1)(2 l2+1)) C^{L0}_{l1 0 l2 0}) at l2, shape (lmax + 1,); NaN where the mode does not
        exist or has odd parity (l1 + l2 + L odd), for which the normalisation is not defined.

    Notes
    -----
    arXiv:1210.7318, eq. Bmatrix.
    """
    l2 = np.arange(lmax + 1)
    factor = np.full(lmax + 1, np.nan)
    use = existing(L, d, lmax) & ((d + L) % 2 == 0)
    clebsch = (-1) ** d * np.sqrt(2 * L + 1) * spin_coupling(L, d, 0, lmax)[use]
    factor[use] = np.sqrt(2 * L + 1) / (np.sqrt((2.0 * l2[use] + 1) * (2.0 * (l2[use] - d) + 1)) * clebsch)
    return factor


def to_bennett(biposh: NDArray, modes: Sequence[Mode]) -> NDArray:
    """BipoSH of shape (..., n_mode, lmax + 1) in the Bennett normalisation; NaN for odd parity."""
    if biposh.ndim < 2 or biposh.shape[-2] != len(modes):
        raise InputError(f"biposh has shape {biposh.shape}, but {len(modes)} modes need (..., {len(modes)}, lmax + 1).")
    lmax = biposh.shape[-1] - 1
    return biposh * np.stack([bennett_factor(L, d, lmax) for L, _, d in modes])
