r"""Quadratic maximum-likelihood modes of a beam in the frame of its scan, from one map.

A beam of orders b_ls, s > 0, changes a map by dP s = 2 Re sum_s w_s S_s. With beta_s = b_ls / b_l0, constant in bins,

    q = y' dP s^,   y = C^-1 d,   s^ = S P^t y,   beta^ = F^-1 (q - <q>),   F = 1/2 Tr[C^-1 dC C^-1 dC'],

is unbiased for small beta with the smallest variance (Hanson, Lewis & Challinor 2010, arXiv:1003.0198). All degrees of
an order take one adjoint transform of spin s. Every L of the anisotropy and its exact shape under the scan are in dP:
unlike BipoSH coefficients up to an L_max, nothing leaks in from beyond.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcsim.bipolar import power_spectrum
from mcsim.errors import InputError
from mcsim.instrument.scan import Moments
from mcsim.simulation import convolve
from mcsim.simulation.filtering import LOWEST
from mcsim.simulation.map_filter import MapFilter
from mcsim.sphere import healpix
from mcsim.support.arrays import Alm, Map, Matrix, Vector


class Weighted(NamedTuple):
    """A map as the estimate needs it: s^, uK, and E and B of conj(w_s) y for every order, (order, 2, size), uK^-1."""

    sky: Alm
    turned: NDArray[np.complex128]


@dataclass(frozen=True, eq=False)
class BeamModes:
    """Estimate b_ls / b_l0, s = 1 ... ``orders``, in bins of ``width`` degrees, the first of which begins at l = 0.

    Real vectors hold the real parts of what exists, order by order and bin by bin, and then the imaginary parts: K
    numbers, of q in units of 1 / beta, which has none.

    Raises
    ------
    InputError
        If the moments have fewer orders, or other pixels.

    Notes
    -----
    Equal to whole matrices at nside 4, and for a slightly elliptical beam the mean is b_l2 / b_l0 of the simulator's
    beam, sign and phase included (tests/unit/test_beam_modes.py).
    """

    filter: MapFilter  #: of the map, with circular beam
    moments: Moments  #: orientation moments of its samples
    #: orders, width: highest order s, and width of the bins in ell, from 0
    orders: int
    width: int

    def __post_init__(self) -> None:
        """Check the moments."""
        if not 1 <= self.orders <= self.moments.smax:
            raise InputError(f"orders = {self.orders} is outside 1 ... {self.moments.smax}, those of the moments.")
        if self.moments.npix != self.filter.inverse.npix:
            raise InputError(
                f"the moments have {self.moments.npix} pixels, the map {self.filter.inverse.npix}; give both of one "
                "nside."
            )

    @property
    def first(self) -> NDArray[np.int64]:
        """Return the first ell of every bin."""
        return np.arange(0, self.filter.inverse.lmax + 1, self.width)

    @cached_property
    def _shape(self) -> Matrix:
        """What multiplies beta at every degree, shape (order, lmax + 1)."""
        circular = self.filter.inverse.maps[0].response.factors[0].real
        ell = np.arange(circular.size)
        return np.stack([np.where(ell >= max(s, LOWEST), circular, 0.0) for s in range(1, self.orders + 1)])

    @cached_property
    def _known(self) -> NDArray[np.bool_]:
        """Return True for orders and bins that exist, shape (order, bin)."""
        return np.asarray(np.add.reduceat(self._shape != 0.0, self.first, axis=-1) > 0)

    def weighted(self, map_uk: Map) -> Weighted:
        """Return what a map contributes; it takes a solution of its inverse covariance. InputError as of the filter."""
        inverse = self.filter.inverse
        observed = self.filter.observed(map_uk)
        sky = inverse.wiener(observed)
        y = inverse.apply(observed, sky)[0]
        turned = [convolve.turned([(y, self.moments)], s) for s in range(1, self.orders + 1)]
        fields = [healpix.adjoint(pair, inverse.lmax, inverse.nthreads, spin=s) for s, pair in enumerate(turned, 1)]
        return Weighted(sky, np.stack(fields))

    def products(self, one: Weighted, other: Weighted) -> Vector:
        """Return y' dP s^ of one map's y and another's s^, per unit of every real number of :meth:`spectra`."""
        lmax = self.filter.inverse.lmax
        degrees = 2.0 * np.arange(lmax + 1) + 1.0
        found = np.empty((2, *self._known.shape))
        for order, fields in enumerate(one.turned):
            for part, field in enumerate(fields):
                terms = -2.0 * degrees * self._shape[order] * power_spectrum(field, other.sky, lmax)
                found[part, order] = np.add.reduceat(terms, self.first)
        return np.asarray(found[:, self._known].ravel())

    def score(self, map_uk: Map) -> Vector:
        """Return q, shape (K,), of a map in uK, shape (npix,); its mean for a circular beam is the mean field."""
        one = self.weighted(map_uk)
        return self.products(one, one)

    def fisher(self, probes: Sequence[Weighted]) -> Matrix:
        """Return F, shape (K, K), from all pairs of two or more random maps that :meth:`probe` makes."""
        total, pairs = np.zeros((2 * int(self._known.sum()),) * 2), 0
        for i, one in enumerate(probes):
            for other in probes[:i]:
                both = self.products(one, other) + self.products(other, one)
                total += np.outer(both, both)
                pairs += 1
        if pairs == 0:
            raise InputError("the Fisher matrix needs at least two random maps; give more.")
        return np.asarray(total / (2.0 * pairs))

    def probe(self, number: int) -> Weighted:
        """Return a random map of the filter's covariance, weighted."""
        return self.weighted(self.filter.inverse.draw(f"beam modes/{self.filter.name}", number)[0])

    def spectra(self, numbers: Vector) -> NDArray[np.complex128]:
        """Return K real numbers as beta, shape (orders, bins), NaN where an order does not exist."""
        real, imaginary = np.split(numbers, 2)
        found = np.full(self._known.shape, complex(np.nan, np.nan))
        found[self._known] = real + 1j * imaginary
        return found
