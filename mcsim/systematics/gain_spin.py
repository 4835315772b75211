"""A gain that follows the spin."""

from dataclasses import dataclass

import numpy as np

from mcsim.systematics.base import Bound, Effect, Site, Wording
from mcsim.systematics.parametrization import Angle, Vector
from mcsim.systematics.spacecraft import spin_phase


@dataclass(frozen=True, kw_only=True)
class GainSpin(Effect):
    """Gain 1 + amplitude cos(spin phase - phase), of sky and dipole alike.

    Attributes
    ----------
    amplitude
        Fraction.
    phase_deg
        Spin phase at which the gain is highest: angle of the line of sight about the spin axis, from the Sun's side.

    Notes
    -----
    Harmonics of the spin and gain noise without a phase average out faster than this term, which every spin repeats.
    """

    name = "gain_spin"
    scope = "channel"
    unit = "fraction"
    title = "spin-synchronous gain"
    wording = Wording("{} of the gain", " %", 100.0)
    cause = "A receiver or its supply that is heated by the Sun once every spin, faster than calibration follows."
    signature = "Sky and dipole times a pattern fixed to the Sun: additive at low l, in the frame of the scan."
    source = "Hinshaw et al. 2003, ApJS 148, 63 (limits); Planck 2015 results III, A&A 594, A3 (thermal effects)"
    step = 2e-4
    bounds = (Bound("amplitude", 0.0, 0.1, "a prior of this library: far beyond any radiometer in use"),)
    parametrization = Angle(parameter="phase_deg")
    proposed = False

    phase_deg: float = 0.0

    def gain(self, time_s: Vector, site: Site) -> Vector | None:
        """Return a wave of the period of the spin."""
        if self.amplitude == 0.0:
            return None
        return np.asarray(
            self.amplitude * np.cos(spin_phase(site.pointed(self.name), time_s) - np.deg2rad(self.phase_deg))
        )
