"""Filter one map by its inverse covariance: the coefficients of which BipoSH are quadratic maximum-likelihood."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from mcsim.errors import InputError
from mcsim.simulation.inverse_covariance import InverseCovariance
from mcsim.sphere import alm as alm_
from mcsim.sphere import healpix
from mcsim.sphere.checks import UNSEEN_BELOW, check_map
from mcsim.support.arrays import Alm, Map, Maps, Vector, divided

LEVELS = 1024  #: of the noise that predictions tell apart
TOLERANCE = 1e-6  #: relative residual at which the inverse covariance of a map is found

DIPOLE_UK = 100.0
"""Rms of the monopole and of the dipole that maps may have besides their sky, so that nothing is learnt from them."""


def unknown_dipole(cl: Vector, rms_uk: float = DIPOLE_UK) -> Vector:
    """Return the spectrum with an unknown monopole and dipole of this rms, uK^2."""
    found = cl.copy()
    found[:2] += (4.0 * np.pi * rms_uk**2 / np.array([1.0, 3.0]))[: cl.size]
    return found


@dataclass(frozen=True, eq=False)
class MapFilter:
    """Filter of one map."""

    name: str  #: of the map
    inverse: InverseCovariance  #: its inverse covariance, with circular beam and pixel window as response
    window: Vector  #: pixel window that the analysis divides out, shape (>= lmax + 1,)
    lmax: int  #: highest degree of the result

    @cached_property
    def total(self) -> Vector:
        """Return C_l of the map over its pixel window if its noise were uniform, uK^2, shape (lmax of the sky + 1,)."""
        noise = 4.0 * np.pi / self.inverse.npix / self._precision[self._precision > 0.0].mean()
        return np.asarray(self.inverse.cl * self._beam**2 + noise / self.window[: self.inverse.lmax + 1] ** 2)

    @property
    def uniform(self) -> bool:
        """Return True if all pixels have the same noise, and nothing was fitted: the filter is then diagonal."""
        return self.inverse.maps[0].templates is None and bool(np.all(self._precision == self._precision[0]))

    def noise(self, power: Map) -> Vector:
        """Return the mean C_l of noise in what the filter measures, uK^2, shape (lmax of the sky + 1,).

        ``power`` is its variance times the pixel area, uK^2 sr, shape (npix,). Noise that changes slowly over the
        wavelength of a degree counts as the filter weights the pixels there, by w^2 with w = 1 / C_l of sky and noise.
        """
        seen = self._precision > 0.0
        order = np.argsort(self._precision[seen])
        parts = np.array_split(order, min(order.size, LEVELS))
        precision, mean = (np.array([one[seen][part].mean() for part in parts]) for one in (self._precision, power))
        square = self.window[: self.inverse.lmax + 1, None] ** 2
        expected = 4.0 * np.pi / self.inverse.npix / precision / square
        weight = ((self.inverse.cl * self._beam**2)[:, None] + expected) ** -2.0 * [part.size for part in parts]
        return np.asarray((weight * mean / square).sum(axis=1) / weight.sum(axis=1))

    def apply(self, map_uk: Map, near: Alm | None = None) -> tuple[Alm, Alm]:
        """Return the filtered coefficients, uK^-1, and the Wiener-filtered sky, uK, near which the next ones may be.

        InputError for a map of other pixels, or without a value in a pixel that has weight.
        """
        observed = self.observed(map_uk)
        window = self.window[: self.inverse.lmax + 1]
        if self.uniform:
            alm = healpix.analysis(observed[0], self.lmax, nthreads=self.inverse.nthreads)
            found = alm_.multiply(alm, 1.0 / (window * self.total), self.lmax)
            sky = alm_.multiply(found, self.inverse.cl * self._beam, self.lmax)
            return found, alm_.resize(sky, self.lmax, self.inverse.lmax)
        inverse = self.inverse
        sky = inverse.solve(inverse.adjoint(inverse.weighted(observed)), near)
        found = healpix.adjoint(inverse.apply(observed, sky)[0], inverse.lmax, inverse.nthreads)
        found = alm_.multiply(found, window, inverse.lmax)
        # Where the sky is far above the noise the difference of the two loses digits; s^ = S B x does not.
        power = inverse.cl * self._beam
        bright = alm_.degrees(inverse.lmax) <= np.max(np.flatnonzero(power * self._beam > self.total / 2.0), initial=-1)
        usable = bright & (power[alm_.degrees(inverse.lmax)] > 0.0)
        found = np.where(usable, alm_.multiply(sky, divided(1.0, power), inverse.lmax), found)
        return alm_.resize(found, inverse.lmax, self.lmax), sky

    def observed(self, map_uk: Map) -> Maps:
        """Return a map with zeros where it has no weight, shape (1, npix); InputError as of :meth:`apply`."""
        check_map(map_uk, self.inverse.nside, f"map {self.name}")
        found = np.where(self._precision > 0.0, map_uk, 0.0)
        if missing := int(np.sum(~(np.abs(found) < -UNSEEN_BELOW))):
            raise InputError(
                f"map {self.name} has {missing} pixels without a value to which its filter gives weight; mask them "
                "(map.mask) in the run whose filter it is."
            )
        return found[None]

    def probe(self, number: int) -> Alm:
        """Return filtered coefficients of random data of the filter's own covariance."""
        return self.apply(self.inverse.draw(f"filter/{self.name}", number)[0])[0]

    @property
    def _precision(self) -> Map:
        return self.inverse.maps[0].precision

    @property
    def _beam(self) -> Vector:
        response = self.inverse.maps[0].response.factors[0].real
        return np.asarray(response / self.window[: self.inverse.lmax + 1])
