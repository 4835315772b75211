"""Modes (L, M, d) of BipoSH spectra, stored at ell = l2 with d = l2 - l1, and their two normalisations."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcsim.errors import InputError
from mcsim.sphere.clebsch import band, evaluate

Indices = tuple[int, int, int]  #: (L, M, d) of a mode, where M may be negative


CONVENTION = "A^{LM}_{l1 l2} = sum a_{l1 m1} conj(a_{l2 m2}) (-1)^{m2} C^{LM}_{l1 m1 l2 -m2}, ell = l2, d = l2 - l1"
NORMALISATION = "Hajian-Souradeep"


class Mode(NamedTuple):
    """One BipoSH spectrum: L, M and d = l2 - l1."""

    L: int
    M: int
    d: int

    @property
    def name(self) -> str:
        """Index label, for example ``L2M0d0``."""
        return f"L{self.L}M{self.M}d{self.d}"

    @property
    def parity(self) -> str:
        """Parity of l1 + l2 + L, ``even`` or ``odd``."""
        return "odd" if (self.d + self.L) % 2 else "even"

    @property
    def in_auto(self) -> bool:
        """Return True if one map alone has this mode: d >= 0, and not the identically vanishing d = 0 of odd parity."""
        return self.d > 0 or (self.d == 0 and self.parity == "even")

    @property
    def parts(self) -> tuple[bool, ...]:
        """Parts that are not identically zero: False for the real, True for the imaginary one."""
        return (False, True) if self.M > 0 else (self.parity == "odd",)


def modes(L_max: int, both_orders: bool) -> tuple[Mode, ...]:
    """Return all modes up to L_max: of one map (0 <= d <= L), or of ordered pairs of maps (-L <= d <= L)."""
    every = (Mode(L, M, d) for L in range(L_max + 1) for M in range(L + 1) for d in range(-L, L + 1))
    return tuple(mode for mode in every if both_orders or mode.in_auto)


def parse_mode(name: str) -> Mode:
    """Read a mode from its label, for example ``L2M0d-2``; InputError for another label or one that cannot exist."""
    try:
        L, rest = name.removeprefix("L").split("M")
        M, d = rest.split("d")
        mode = Mode(int(L), int(M), int(d))
    except ValueError:
        raise InputError(f"{name!r} is no BipoSH mode; write it like L2M0d0.") from None
    if not (0 <= mode.M <= mode.L and abs(mode.d) <= mode.L and mode.L > 0):
        is_cl = "is that of C_l" if mode == (0, 0, 0) else "does not exist"
        raise InputError(f"the mode {name} {is_cl}; give one with L > 0, 0 <= M <= L and |d| <= L.")
    return mode


def check_modes(modes: Iterable[Indices]) -> None:
    """Raise InputError for a mode that cannot exist: L >= 0, |M| <= L and |d| <= L are needed."""
    for L, M, d in modes:
        if L < 0 or abs(M) > L or abs(d) > L:
            raise InputError(f"mode L={L}, M={M}, d={d} does not exist; |M| and |d| must not exceed L.")


def check_degree(modes: Iterable[Indices], L_max: int, name: str) -> None:
    """Raise InputError for a mode above ``L_max``, where coefficients that ``name`` names in messages end."""
    highest = max((L for L, _, _ in modes), default=0)
    if highest > L_max:
        raise InputError(f"{name} end at L = {L_max}, below L = {highest} of a mode; compute them further.")


def existing(L: int, d: int, lmax: int) -> NDArray[np.bool_]:
    """Return True where A^{LM}_{l2-d, l2} exists, l2 = 0..lmax: 0 <= l1 <= lmax and |l1 - l2| <= L <= l1 + l2."""
    l2 = np.arange(lmax + 1)
    l1 = l2 - d
    return (l1 >= 0) & (l1 <= lmax) & (abs(d) <= L) & (l1 + l2 >= L)


def bennett_factor(mode: Indices, lmax: int) -> NDArray[np.float64]:
    """Return the factor from the Hajian-Souradeep to the Bennett (WMAP) normalisation at ell = l2, shape (lmax + 1,).

    sqrt(2L+1) / (sqrt((2 l1 + 1)(2 l2 + 1)) C^{L0}_{l1 0 l2 0}); NaN where the coefficient does not exist. Raise
    InputError for odd parity, where C^{L0}_{l1 0 l2 0} vanishes, or a mode that cannot exist.

    Notes
    -----
    arXiv:1210.7318, eq. Bmatrix. An explicit sum over Clebsch-Gordan coefficients gives the same:
    tests/unit/test_biposh.py.
    """
    check_modes([mode])
    L, _, d = mode
    if (L + d) % 2:
        raise InputError(
            f"Mode {Mode(*mode).name} has odd parity, for which the Bennett normalisation does not exist; "
            "use the Hajian-Souradeep normalisation."
        )
    tables = band(L, 0, d, lmax)
    factor = np.full(lmax + 1, np.nan)
    for l2 in np.flatnonzero(existing(L, d, lmax + abs(d))[: lmax + 1]).tolist():
        clebsch = evaluate(tables, L, l2, 0)
        factor[l2] = np.sqrt(2 * L + 1) / (np.sqrt((2 * (l2 - d) + 1.0) * (2 * l2 + 1.0)) * clebsch)
    return factor


def to_bennett(biposh: NDArray, modes: Sequence[Indices]) -> NDArray:
    """Return BipoSH of shape (..., n_mode, lmax + 1) in the Bennett normalisation; every mode has even parity."""
    lmax = biposh.shape[-1] - 1
    return biposh * np.stack([bennett_factor(mode, lmax) for mode in modes])


def bin_factor(mode: Mode, lmax: int) -> NDArray[np.float64]:
    """Return the factor that makes A^{LM}_{l1 l2} smooth in ell = l2, shape (lmax + 1,).

    It is l(l+1)/2pi times the Bennett factor for even parity. For odd parity, which has no such factor, it is
    l(l+1)/2pi times (-1)^l ((2 l1 + 1)(2 l2 + 1))^{-1/4}, which removes the same alternation of sign and growth with l.
    """
    ell = np.arange(lmax + 1, dtype=float)
    spectrum = ell * (ell + 1.0) / (2.0 * np.pi)
    if mode.parity == "even":
        return spectrum * bennett_factor(mode, lmax)
    other = np.maximum(ell - mode.d, 0.0)
    return spectrum * np.where(ell % 2 == 0, 1.0, -1.0) * ((2.0 * other + 1.0) * (2.0 * ell + 1.0)) ** -0.25
