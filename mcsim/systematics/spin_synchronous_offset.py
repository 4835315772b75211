"""A signal of the spacecraft's own that returns with every spin."""

from dataclasses import dataclass

import numpy as np

from mcsim.systematics.base import Bound, Effect, Site, Wording
from mcsim.systematics.parametrization import Angle, Vector
from mcsim.systematics.spacecraft import spin_phase


@dataclass(frozen=True, kw_only=True)
class SpinSynchronousOffset(Effect):
    """Samples have amplitude cos(spin phase - phase) added, whatever the sky.

    Attributes
    ----------
    amplitude
        Half of the range, uK.
    phase_deg
        Spin phase at which the signal is highest: angle of the line of sight about the spin axis, from the Sun's side.
    """

    name = "spin_synchronous_offset"
    scope = "channel"
    unit = "uK"
    wording = Wording("{}", " µK")
    cause = "The Sun heats the spacecraft, or power is switched, in step with the spin."
    signature = "A pattern of the ecliptic frame at low l, the same in both halves: stripes are too regular to average."
    source = "Hinshaw et al. 2003, ApJS 148, 63 (limits on the response to the surroundings)"
    step = 0.5
    bounds = (
        Bound(
            "amplitude",
            0.0,
            1000.0,
            "a prior of this library: a mK is seen in the time stream by eye",
        ),
    )
    parametrization = Angle(parameter="phase_deg")
    proposed = False

    phase_deg: float = 0.0

    def signal(self, time_s: Vector, theta: Vector, phi: Vector, psi: Vector, site: Site) -> Vector:
        """Return a wave of the period of the spin."""
        phase = spin_phase(site.pointed(self.name), time_s)
        return np.asarray(self.amplitude * np.cos(phase - np.deg2rad(self.phase_deg)))
