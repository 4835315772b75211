r"""What the spread of samples over a pixel does to its value, beyond the pixel window and the mean offset.

A sky S(n) = sum_lm a_lm Y_lm(n) has at the distance r from a pixel's centre n, at the angle chi from e_theta (south)
towards e_phi (east),

    S(r, chi) = sum_lm P_l(cos r) a_lm Y_lm(n) + 2 Re sum_{s > 0} e^{-i s chi} sum_lm d^l_{s0}(r) a_lm sY_lm(n).

With rho = sin r, d^l_{s0}(r) is replaced by the sum of h_{l,sn} rho^n, n = s, s + 2, ... up to the order, that comes
closest for samples anywhere in a pixel. The mean over samples then needs the moments <rho^n e^{i s chi}> alone, and one
transform for each s and n. Powers at s = 0 are taken about their mean over pixels, so that h_{l,00} is the mean of
P_l(cos r), which stands in place of the pixel window.
"""

from collections.abc import Iterator, Sequence
from functools import lru_cache

import numpy as np

from mcsim.bipolar.theory.harmonics import spin_functions
from mcsim.instrument.scan import Moments
from mcsim.simulation import convolve
from mcsim.sphere import alm as alm_
from mcsim.sphere import healpix
from mcsim.support.arrays import Alm, Cl, Map, Maps, Vector


class Expansion:
    """Windows h_{l,sn} of an expansion up to an order, for distances r with shares ``weight``, shape (n,) each.

    Attributes
    ----------
    order
        Highest power of the samples' offsets.
    smooth
        Mean of P_l(cos r), shape (lmax + 1,).
    windows
        By s and n > 0, shape (lmax + 1,) each.
    means
        Mean of rho^n, by n = 2, 4.
    """

    def __init__(self, r: Vector, weight: Vector, lmax: int, order: int) -> None:
        self.order = order
        rho, root = np.sin(r), np.sqrt(weight)
        functions = spin_functions(order, lmax, r) / np.sqrt((2 * np.arange(lmax + 1) + 1) / (4 * np.pi))[:, None]
        self.smooth = functions[0] @ weight
        self.means = {n: float(weight @ rho**n) for n in range(2, order + 1, 2)}
        self.windows: dict[tuple[int, int], Cl] = {}
        for s in range(min(order, lmax) + 1):  # sY_lm begins at l = s
            powers = [n for n in range(s, order + 1, 2) if n]
            wanted = functions[s] - self.smooth[:, None] if s == 0 else functions[s]
            columns = np.stack([rho**n - (self.means[n] if s == 0 else 0.0) for n in powers])
            scale = np.maximum(np.abs(columns).max(axis=1), np.finfo(float).tiny)  # of samples at the centres, say
            found = np.linalg.lstsq((columns / scale[:, None] * root).T, (wanted * root).T, rcond=None)[0]
            self.windows |= {(s, n): row / top for n, row, top in zip(powers, found, scale, strict=True)}


@lru_cache(maxsize=8)
def expansion(nside: int, lmax: int, order: int, spread: float = 1.0) -> Expansion:
    """Return the expansion for samples all over the pixels, ``spread`` times as far from their centres."""
    r, weight = healpix.distances_from_centres(nside)
    return Expansion(spread * r, weight, lmax, order)


def transforms(order: int) -> int:
    """Return the transforms that powers of offsets up to an order take, in units of one at spin 0."""
    return sum(1 if s == 0 else 2 for s in range(order + 1) for n in range(s, order + 1, 2) if n)


def offset_maps(circular: Alm, terms: Expansion, moments: Sequence[Moments], nthreads: int = 1) -> list[Map]:
    """Return what the samples' offsets add to S_0 through ``terms.smooth``, uK, shape (npix,), for each scan.

    ``circular``: the sky through the circular part of the beam, without a pixel window. Every scan needs moments of
    offsets up to ``terms.order``, of which the maps are linear.
    """
    found = [np.zeros(m.npix) for m in moments]
    for s, n, made in _transforms(circular, terms, moments[0].nside, nthreads):
        for total, m in zip(found, moments, strict=True):
            moment = m.spin_of_offsets(n, s)
            if s == 0:
                total += np.where(m.hits > 0, moment - terms.means[n], 0.0) * made[0]
            else:
                convolve.add_twice_real_part(np.conj(moment), made[0], made[1], total)
    return found


def _transforms(circular: Alm, terms: Expansion, nside: int, nthreads: int) -> Iterator[tuple[int, int, Maps]]:
    lmax = alm_.lmax_of(circular.size) or 0
    for (s, n), window in terms.windows.items():
        # ducc0 returns minus the sum over sY_lm from E alone.
        filtered = alm_.multiply(circular, -window if s else window, lmax)
        both = np.stack([filtered, np.zeros_like(filtered)]) if s else filtered[None]
        yield s, n, healpix.synthesis(both, nside, lmax, spin=s, nthreads=nthreads)
