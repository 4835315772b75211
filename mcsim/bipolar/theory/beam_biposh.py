"""Beam-BipoSH B^{LM}_{l1 l2}: a non-circular beam under any scan in the bipolar spherical-harmonic basis."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mcsim.bipolar.modes import Indices, check_degree, check_modes, existing
from mcsim.bipolar.theory.harmonics import negative_spin
from mcsim.errors import InputError
from mcsim.sphere.checks import check_finite, check_whole
from mcsim.sphere.wigner import threej_family
from mcsim.support.compiled import njit


@dataclass(frozen=True, eq=False)
class ScannedBeam:
    """A beam and the moments of the orientations in which it observed the sky.

    Raises
    ------
    InputError
        If an array has another shape or is not finite.
    """

    blm: NDArray[np.complex128]  #: b_lm of the beam at the pole, complex, shape (mmax + 1, lmax + 1), ``blm[m, l]``
    #: w_{s,LM}, shape (smax + 1, L_max + 1, 2 L_max + 1), as :mod:`mcsim.bipolar.theory.harmonics` makes them: s = 0
    #: has the weights of the pixels
    w: NDArray[np.complex128]

    def __post_init__(self) -> None:
        """Check the shapes and values."""
        if self.blm.ndim != 2 or self.w.ndim != 3 or self.w.shape[2] != 2 * self.w.shape[1] - 1:
            raise InputError(
                f"b_lm of shape {self.blm.shape} and w of {self.w.shape} are no scanned beam; give (mmax + 1, "
                "lmax + 1) and (smax + 1, L_max + 1, 2 L_max + 1)."
            )
        check_finite(self.blm, "blm")
        check_finite(self.w, "w")

    def check(self, lmax: int, modes: Sequence[Indices]) -> None:
        """Raise InputError unless the beam reaches ``lmax``, and the moments the degree L of every mode."""
        check_whole(lmax, "lmax")
        check_modes(modes)
        if self.blm.shape[1] <= lmax:
            raise InputError(f"the beam ends at l = {self.blm.shape[1] - 1}, below lmax {lmax}; compute it further.")
        check_degree(modes, self.L_max, "the moments w_s")

    @property
    def weighted(self) -> bool:
        """Return True if the weights of the pixels differ."""
        return bool(np.any(self.w[0, 1:] != 0.0))

    @property
    def circular(self) -> "ScannedBeam":
        """Return the circular part of the beam, with the same weights."""
        return ScannedBeam(self.blm[:1], self.w[:1])

    @property
    def smax(self) -> int:
        """Return the highest spin that both the beam and the moments have."""
        return min(len(self.blm), len(self.w)) - 1

    @property
    def L_max(self) -> int:
        """Return the highest degree of the moments."""
        return self.w.shape[1] - 1

    def within(self, L_max: int) -> "ScannedBeam":
        """Return the beam with its moments up to a degree."""
        beyond = max(self.L_max - L_max, 0)
        return self if beyond == 0 else ScannedBeam(self.blm, self.w[:, :-beyond, beyond:-beyond])

    def response(self, lmax: int) -> NDArray[np.complex128]:
        """Return k_l b_ls for s = -smax..smax, shape (2 smax + 1, lmax + 1), zero beyond the beam's lmax."""
        top = min(lmax, self.blm.shape[1] - 1)
        k = np.sqrt(4 * np.pi / (2.0 * np.arange(top + 1) + 1))
        positive = np.zeros((self.smax + 1, lmax + 1), dtype=np.complex128)
        positive[:, : top + 1] = self.blm[: self.smax + 1, : top + 1] * k
        sign = (-1.0) ** np.arange(self.smax, 0, -1)
        return np.concatenate([sign[:, None] * positive[:0:-1].conj(), positive])

    def orientations(self) -> NDArray[np.complex128]:
        """Return w_{s,LM} for s = -smax..smax, shape (2 smax + 1, L_max + 1, 2 L_max + 1)."""
        w = self.w[: self.smax + 1]
        return np.concatenate([negative_spin(w)[:0:-1], w])


def beam_biposh(beam: ScannedBeam, mode: Indices, lmax: int) -> NDArray[np.complex128]:
    """Return B^{LM}_{l2-d, l2} of a beam under any scan at l2 = 0..lmax, complex, NaN where it does not exist.

    The mode is (L, M, d), with d = l2 - l1 of either sign and any |M| <= L; lmax is the highest l1 and l2. Raise
    InputError if |M| or |d| exceeds L, or the moments end below L.

    Notes
    -----
    B^{LM}_{l1 l2} = (-1)^{l1-l2} sum_s w_{s,LM} k_{l2} b_{l2,s} sqrt((2 l1+1)(2 l2+1)/4pi) (l1 L l2; 0 s -s), both
    parities. It equals the definition of arXiv:1210.7318, eq. beam-BipoSH, to 1e-13 of the largest coefficient for
    random complex beams with odd m and orientations without symmetry (tests/unit/test_predict_brute_force.py). A
    circular beam gives (-1)^l B_l sqrt(2l+1) for L = 0 and nothing else.
    """
    beam.check(lmax, [mode])
    L, M, d = mode
    l2 = np.arange(lmax + 1)
    exists = existing(L, d, lmax)
    total = np.zeros(lmax + 1, dtype=np.complex128)
    response, orientations = beam.response(lmax), beam.orientations()
    top = min(beam.smax, L)
    for s in range(-top, top + 1):
        w = orientations[beam.smax + s, L, beam.L_max + M]
        total += w * response[beam.smax + s] * _spin_coupling(L, d, s, lmax)
    norm = np.sqrt(np.where(exists, (2.0 * l2 + 1) * (2.0 * (l2 - d) + 1), 0.0) / (4 * np.pi))
    return np.where(exists, (-1) ** d * norm * total, np.nan)


@njit(nogil=True)
def _spin_coupling(L: int, d: int, s: int, lmax: int) -> NDArray[np.float64]:
    """Return the 3j symbols (l1 L l2; 0 s -s), l1 = l2 - d, at l2 = 0..lmax; |s| <= L."""
    symbols, family = np.zeros(lmax + 1), np.zeros(2 * L + 1)
    for l2 in range(abs(s), lmax + 1):
        lowest, n = threej_family(L, l2, s, -s, family)
        if 0 <= l2 - d - lowest < n:
            symbols[l2] = family[l2 - d - lowest]
    return symbols
