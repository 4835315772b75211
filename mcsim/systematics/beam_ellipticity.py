"""A beam that is more elongated than the fiducial one."""

from dataclasses import dataclass

import numpy as np

from mcsim.errors import InputError
from mcsim.instrument.beams import Beam
from mcsim.systematics.base import Bound, Effect, Site, Wording, scan_direction
from mcsim.systematics.parametrization import Angle
from mcsim.systematics.shape import stretched


@dataclass(frozen=True, kw_only=True)
class BeamEllipticity(Effect):
    """The beam stretched to major/minor = 1 + amplitude at the same area; a negative amplitude turns it by 90 deg.

    Attributes
    ----------
    amplitude
        Ratio of the axes less one, of a beam that was round.
    angle_deg
        Direction of the major axis, from beam x (along the scan) towards y.
    """

    name = "beam_ellipticity"
    scope = "channel"
    unit = "major/minor - 1"
    wording = Wording("axis ratio {}", offset=1.0)
    cause = "Optics off the axis: defocus, coma-free astigmatism, or a horn that looks past the centre of the mirror."
    signature = "Even L, growing as l^2, fixed to the scan through w_2."
    source = "Joshi et al. arXiv:1210.7318, Sec. IV; Fosalba et al. 2002, Phys. Rev. D 65, 063003"
    step = 0.02
    bounds = (
        Bound(
            "amplitude",
            -1.0,
            1.0,
            "a prior of this library: 1.38 is the largest of Planck LFI (Planck 2013 results II, A&A 571, A2)",
        ),
    )
    parametrization = Angle(multiple=2)

    angle_deg: float = 0.0

    def beam(self, beam: Beam, site: Site) -> Beam:
        """Stretch the beam along the angle and squeeze it across."""
        if abs(self.amplitude) > 2.0:
            raise InputError(
                f"effect {self.name}: amplitude = {self.amplitude:g} is no beam to speak of; keep it within +-2."
            )
        ratio, angle = 1.0 + abs(self.amplitude), np.deg2rad(self.angle_deg)
        if self.amplitude < 0.0:
            angle += np.pi / 2
        return stretched(beam, np.sqrt(ratio), 1.0 / np.sqrt(ratio), angle, 32, 2)

    def direction(self) -> str:
        """Return the direction in the frame of the beam."""
        return "with the major axis " + scan_direction(self.angle_deg, 180.0)
