"""A dipole that was not all taken off."""

from dataclasses import dataclass

from mcsim.sphere.sky import dipole_alm
from mcsim.systematics.base import Alm, Bound, DirectedEffect, Draw, Site, Wording
from mcsim.systematics.parametrization import SkyVector


@dataclass(frozen=True, kw_only=True)
class DipoleResidual(DirectedEffect):
    """A dipole d . n is left in the channel, the same at all times."""

    name = "dipole_residual"
    scope = "channel"
    unit = "uK"
    title = "residual dipole"
    wording = Wording("{}", " µK")
    cause = "Error of the dipole that was subtracted, or of the channel's absolute calibration."
    signature = "l = 1, the same in both halves."
    source = "Hinshaw et al. 2009, ApJS 180, 225 (the dipole and its error)"
    step = 0.5
    bounds = (Bound("amplitude", 0.0, 340.0, "a tenth of the CMB's dipole (Hinshaw et al. 2009, ApJS 180, 225)"),)
    parametrization = SkyVector(matched_filter=False)

    def sky(self, sky: Alm, site: Site, draw: Draw) -> Alm:
        """Add the dipole."""
        return sky + dipole_alm(self.vector, site.lmax)
