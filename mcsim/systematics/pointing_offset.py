"""A line of sight that is displaced from the fiducial one."""

from dataclasses import dataclass

import numpy as np

from mcsim.instrument.beams import Beam
from mcsim.systematics.base import Bound, Effect, Site, Wording, scan_direction
from mcsim.systematics.parametrization import Angle, Vector
from mcsim.systematics.shape import displaced
from mcsim.systematics.spacecraft import axes


@dataclass(frozen=True, kw_only=True)
class PointingOffset(Effect):
    """The true direction is the fiducial one plus a vector fixed to the beam.

    Attributes
    ----------
    amplitude
        Length of the vector, arcmin.
    angle_deg
        Its direction, from beam x (along the scan) towards y (towards the spin axis).

    Notes
    -----
    The beam is turned rigidly along the great circle, with its axes carried along: exact, in both routes.
    """

    name = "pointing_offset"
    scope = "channel"
    unit = "arcmin"
    wording = Wording("{}", "′")
    cause = "A boresight calibrated on planets, thermal bending, or an error of the time stamps (along the scan)."
    signature = "The gradient of the sky along or across the scan, through w_1; acts on the dipole too."
    source = "Jarosik et al. 2007, ApJS 170, 263 (WMAP); Planck 2013 results VI, A&A 571, A6 (Planck HFI)"
    step = 0.2
    bounds = (
        Bound("amplitude", 0.0, 120.0, "a prior of this library: reconstructed pointing is never wrong by two degrees"),
    )
    parametrization = Angle()

    angle_deg: float = 0.0

    def pointing(self, beam: Beam, site: Site) -> Beam:
        """Displace the beam."""
        return displaced(beam, np.deg2rad(self.angle_deg), np.deg2rad(self.amplitude / 60.0))

    def moved(self, theta: Vector, phi: Vector, psi: Vector) -> tuple[Vector, Vector, Vector] | None:
        """Rotate every sample's direction and axes in the same way."""
        if self.amplitude == 0.0:
            return theta, phi, psi
        distance, angle = np.deg2rad(self.amplitude / 60.0), np.deg2rad(self.angle_deg)
        outward, south, east = axes(theta, phi)
        # Along the displacement and to its left; the first turns down, the second stays.
        forward = np.cos(psi + angle) * south + np.sin(psi + angle) * east
        left = np.cos(psi + angle) * east - np.sin(psi + angle) * south
        line = np.cos(distance) * outward + np.sin(distance) * forward
        forward = np.cos(distance) * forward - np.sin(distance) * outward
        axis = np.cos(angle) * forward - np.sin(angle) * left
        width = np.hypot(line[0], line[1])
        # x . e_theta = -x_z / sin(theta) and x . e_phi = (n x x)_z / sin(theta), as the two are orthogonal.
        turned = np.arctan2(line[0] * axis[1] - line[1] * axis[0], -axis[2])
        return np.arctan2(width, line[2]), np.arctan2(line[1], line[0]) % (2.0 * np.pi), turned

    def direction(self) -> str:
        """Return the direction in the frame of the beam."""
        return scan_direction(self.angle_deg)
