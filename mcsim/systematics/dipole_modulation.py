"""A sky with more power on one side."""

from dataclasses import dataclass

from mcsim.systematics.base import Alm, Bound, DirectedEffect, Draw, Site, Wording
from mcsim.systematics.parametrization import SkyVector
from mcsim.systematics.product import multiplied


@dataclass(frozen=True, kw_only=True)
class DipoleModulation(DirectedEffect):
    """The sky times 1 + A . n, in every channel."""

    name = "dipole_modulation"
    scope = "common"
    unit = "fraction"
    title = "dipole modulation of the sky"
    wording = Wording("{} of the signal", " %", 100.0)
    cause = "A sky that is not statistically isotropic: a hemispherical power asymmetry."
    signature = "L = 1, d = 1, the same in every channel and split, at all l."
    source = "Gordon et al. 2005, Phys. Rev. D 72, 103002"
    step = 0.01
    bounds = (Bound("amplitude", 0.0, 1.0, "beyond it the signal changes sign in a part of the sky"),)
    parametrization = SkyVector(matched_filter=False)

    def sky(self, sky: Alm, site: Site, draw: Draw) -> Alm:
        """Modulate the sky."""
        a, b, c = self.vector
        return sky + multiplied(sky, site.lmax, lambda x, y, z: a * x + b * y + c * z, 1)
