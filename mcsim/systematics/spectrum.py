"""A sky whose power spectrum is not the fiducial one."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from mcsim.errors import InputError
from mcsim.sphere import alm as alm_
from mcsim.systematics.base import Alm, Draw, Effect, Site, Vector, Wording
from mcsim.systematics.vectors import along

BANDS = 6

LEAST = -0.99
"""Smallest change of a band that is fitted: an error larger than the power itself asks for less than none."""


KNOWN = 0.25
"""Error of a band up to which the data constrain its power."""

DETECTED = 3.0
"""Standard errors by which a band that is constrained worse has to change to be fitted all the same."""


@dataclass(frozen=True, kw_only=True)
class Spectrum(Effect):
    """C_l times one plus the change of its band, in every channel.

    Attributes
    ----------
    amplitude
        Norm of the fractional changes of all bands.
    bands
        Their direction (its length does not matter): six bands of equal width from l = 2 to the sky's lmax, the
        first numbers of which are 2 + i (lmax - 1) // 6.
    """

    name = "spectrum"
    scope = "common"
    unit = "fraction of C_l"
    title = "power spectrum of the sky"
    wording = Wording("{} of C_ℓ (norm over bands)", " %", 100.0)
    cause = "A cosmology that is not the one of the simulations."
    signature = "L = 0, every channel alike."
    source = "Follows from the definition"
    step = 0.02
    matched_filter = False
    mean_response = True

    bands: tuple[float, ...] = (1.0,) * BANDS

    def sky(self, sky: Alm, site: Site, draw: Draw) -> Alm:
        """Rescaled by the square root."""
        if self.amplitude == 0.0:
            return sky
        change = self.coordinates()
        if np.min(change) < -1.0:
            raise InputError(
                f"effect {self.name}: a band changes by {np.min(change):g}, leaving negative power; keep it above -1."
            )
        ell = np.arange(site.lmax + 1)
        edges = 2 + np.arange(1, BANDS) * (site.lmax - 1) // BANDS
        factor = np.sqrt(1.0 + change[np.searchsorted(edges, ell, side="right")])
        factor[:2] = 1.0
        return alm_.multiply(sky, factor, site.lmax)

    @classmethod
    def basis(cls) -> tuple[Self, ...]:
        """Return the bands one by one."""
        return tuple(cls(amplitude=cls.step, bands=tuple(map(float, row))) for row in np.eye(BANDS))

    def coordinates(self) -> Vector:
        """Fractional change of every band."""
        return along(self.name, "bands", self.bands, self.amplitude)

    @classmethod
    def constrained(cls, coordinates: Vector, precision: NDArray[np.float64]) -> Vector:
        """Set bands to zero that are neither constrained nor detected, such as those beyond the analysed degrees."""
        errors = np.sqrt(np.diag(np.linalg.pinv(precision)))
        silent = (errors > KNOWN) & (np.abs(coordinates) < DETECTED * errors)
        found = np.where(silent, 0.0, coordinates)
        rows = np.flatnonzero(~silent)
        shift = precision[np.ix_(rows, np.flatnonzero(silent))] @ coordinates[silent]
        found[rows] += np.linalg.lstsq(precision[np.ix_(rows, rows)], shift, rcond=None)[0]
        return found

    @classmethod
    def nearest(cls, coordinates: Vector, precision: NDArray[np.float64]) -> Self:
        """Norm and direction, of what leaves every band some power."""
        found = coordinates
        if np.min(coordinates) < LEAST:
            values, vectors = np.linalg.eigh(precision)
            root = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T
            found = lsq_linear(root, root @ coordinates, bounds=(LEAST, np.inf)).x
        norm = float(np.linalg.norm(found))
        return cls(amplitude=norm, bands=tuple(map(float, found / norm))) if norm else cls()
