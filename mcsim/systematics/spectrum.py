"""A sky whose power spectrum is not the fiducial one."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from mcsim.errors import InputError
from mcsim.sphere import alm as alm_
from mcsim.systematics.base import Alm, Bound, Draw, Effect, Site, Wording
from mcsim.systematics.parametrization import Components, Vector

BANDS = 6

LEAST = -0.99
"""Smallest change of a band that is fitted: an error larger than the power itself asks for less than none."""


KNOWN = 0.25
"""Error of a band up to which the data constrain its power."""

DETECTED = 3.0
"""Standard errors by which a band that is constrained worse has to change to be fitted all the same."""


@dataclass(frozen=True, kw_only=True)
class _Bands(Components):
    """Fit the fractional changes of the bands."""

    def constrained(self, coordinates: Vector, precision: NDArray[np.float64]) -> Vector:
        """Set bands to zero that are neither constrained nor detected, such as those beyond the analysed degrees."""
        errors = np.sqrt(np.diag(np.linalg.pinv(precision)))
        silent = (errors > KNOWN) & (np.abs(coordinates) < DETECTED * errors)
        found = np.where(silent, 0.0, coordinates)
        rows = np.flatnonzero(~silent)
        shift = precision[np.ix_(rows, np.flatnonzero(silent))] @ coordinates[silent]
        found[rows] += np.linalg.lstsq(precision[np.ix_(rows, rows)], shift, rcond=None)[0]
        return found

    def nearest(self, coordinates: Vector, precision: NDArray[np.float64]) -> dict[str, Any]:
        """Return norm and direction, of what leaves every band some power."""
        if np.min(coordinates) < LEAST:
            values, vectors = np.linalg.eigh(precision)
            root = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T
            coordinates = lsq_linear(root, root @ coordinates, bounds=(LEAST, np.inf)).x
        return super().nearest(coordinates, precision)


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
    bounds = (
        Bound("amplitude", 0.0, 3.0, "a prior of this library: no band has more than about three times its power"),
    )
    parametrization = _Bands(parameter="bands", count=BANDS, mean_response=True, matched_filter=False)

    bands: tuple[float, ...] = (1.0,) * BANDS

    def sky(self, sky: Alm, site: Site, draw: Draw) -> Alm:
        """Rescale the bands by the square roots of their changes in power."""
        change = self.along("bands")
        if np.min(change) < -1.0:
            raise InputError(
                f"effect {self.name}: a band changes by {np.min(change):g}, leaving negative power; keep it above -1."
            )
        ell = np.arange(site.lmax + 1)
        edges = 2 + np.arange(1, BANDS) * (site.lmax - 1) // BANDS
        factor = np.sqrt(1.0 + change[np.searchsorted(edges, ell, side="right")])
        factor[:2] = 1.0
        return alm_.multiply(sky, factor, site.lmax)
