"""A sky with more power on one side."""

from dataclasses import dataclass

from mcsim.systematics.base import Alm, Draw, Site
from mcsim.systematics.product import multiplied
from mcsim.systematics.vectors import DirectedEffect


@dataclass(frozen=True, kw_only=True)
class DipoleModulation(DirectedEffect):
    """The sky times 1 + A . n, in every channel.

    Attributes
    ----------
    amplitude
        Length of A.
    lon_deg, lat_deg
        Its direction in the frame of the maps.
    """

    name = "dipole_modulation"
    scope = "common"
    unit = "fraction"
    cause = "A sky that is not statistically isotropic: a hemispherical power asymmetry."
    signature = "L = 1, d = 1, the same in every channel and split, at all l."
    source = "Gordon et al. 2005, Phys. Rev. D 72, 103002"
    step = 0.01
    matched_filter = False

    def sky(self, sky: Alm, site: Site, draw: Draw) -> Alm:
        """Modulated."""
        if self.amplitude == 0.0:
            return sky
        a, b, c = self.coordinates()
        return sky + multiplied(sky, site.lmax, lambda x, y, z: a * x + b * y + c * z, 1)
