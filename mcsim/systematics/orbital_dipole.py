"""The dipole of the yearly motion, subtracted with an error."""

from dataclasses import dataclass

import numpy as np

from mcsim.systematics.base import Bound, Effect, Site, Wording
from mcsim.systematics.parametrization import Angle, Vector
from mcsim.systematics.spacecraft import axes, heading

ORBITAL_UK = 270.7
"""29.78 km/s over the speed of light, times 2.7255 K."""


@dataclass(frozen=True, kw_only=True)
class OrbitalDipole(Effect):
    """A share of the dipole of the Earth's motion about the Sun is left in the samples.

    Attributes
    ----------
    amplitude
        Fraction of the dipole of 270.7 uK.
    phase_deg
        Direction of what is left: 0 along the motion (an error of size), 90 towards the Sun (an error of time).

    Notes
    -----
    A circular orbit in the ecliptic, with the anti-Sun direction of the scan. The rest of the dipole is not simulated:
    it is taken to be subtracted.
    """

    name = "orbital_dipole"
    scope = "channel"
    unit = "fraction of 270.7 uK"
    title = "residual orbital dipole"
    wording = Wording("{} of the orbital dipole", " %", 100.0)
    cause = "Velocity, time stamps or beam efficiency wrong where the annual dipole is subtracted or calibrates."
    signature = "A dipole that turns through the year: of opposite sign in the halves, in the ecliptic plane."
    source = "Hinshaw et al. 2003, ApJS 148, 63, and Planck 2015 results V, A&A 594, A5 (the annual dipole calibrates)"
    step = 2e-3
    bounds = (Bound("amplitude", 0.0, 2.0, "at 2 an orbital dipole of the right size has the opposite sign"),)
    parametrization = Angle(parameter="phase_deg")
    proposed = False

    phase_deg: float = 0.0

    def signal(self, time_s: Vector, theta: Vector, phi: Vector, psi: Vector, site: Site) -> Vector:
        """Return what is left."""
        towards = heading(site.pointed(self.name).model, time_s, site.frame, np.deg2rad(self.phase_deg))
        return np.asarray(self.amplitude * ORBITAL_UK * np.sum(towards * axes(theta, phi)[0], axis=0))
