"""A gain that follows the year."""

from dataclasses import dataclass

import numpy as np

from mcsim.systematics.base import Bound, Effect, Site, Wording
from mcsim.systematics.parametrization import Angle, Vector


@dataclass(frozen=True, kw_only=True)
class GainDrift(Effect):
    """Gain 1 + amplitude cos(2 pi t / orbit period - phase), of sky and dipole alike.

    Attributes
    ----------
    amplitude
        Fraction.
    phase_deg
        Part of the year at which the gain is highest, as an angle from the start of the survey.

    Notes
    -----
    The dipole is subtracted with the fiducial gain, 1: what is left of it is most of the effect.
    """

    name = "gain_drift"
    scope = "channel"
    unit = "fraction"
    title = "annual gain drift"
    wording = Wording("{} of the gain", " %", 100.0)
    cause = "Temperature of the receiver over the year, followed imperfectly by the calibration."
    signature = (
        "Sky and dipole modulated with the year: additive at low l, ordered by the scan, opposite in the halves."
    )
    source = "Jarosik et al. 2007, ApJS 170, 263 (gain model)"
    step = 2e-4
    bounds = (Bound("amplitude", 0.0, 0.1, "a prior of this library: far beyond any radiometer in use"),)
    parametrization = Angle(parameter="phase_deg")

    phase_deg: float = 0.0

    def gain(self, time_s: Vector, site: Site) -> Vector | None:
        """Return a wave of the period of the orbit."""
        if self.amplitude == 0.0:
            return None
        turns = time_s / site.pointed(self.name).model.orbit_period_s
        return np.asarray(self.amplitude * np.cos(2.0 * np.pi * turns - np.deg2rad(self.phase_deg)))
