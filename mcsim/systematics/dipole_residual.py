"""A dipole that was not all taken off."""

from dataclasses import dataclass

from mcsim.sphere.sky import dipole_alm
from mcsim.systematics.base import Alm, Draw, Site
from mcsim.systematics.vectors import DirectedEffect


@dataclass(frozen=True, kw_only=True)
class DipoleResidual(DirectedEffect):
    """A dipole d . n is left in the channel, the same at all times.

    Attributes
    ----------
    amplitude
        Length of d, uK.
    lon_deg, lat_deg
        Its direction in the frame of the maps.
    """

    name = "dipole_residual"
    scope = "channel"
    unit = "uK"
    cause = "Error of the dipole that was subtracted, or of the channel's absolute calibration."
    signature = "l = 1, the same in both halves."
    source = "Hinshaw et al. 2009, ApJS 180, 225 (the dipole and its error)"
    step = 0.5
    matched_filter = False

    def sky(self, sky: Alm, site: Site, draw: Draw) -> Alm:
        """With the dipole added."""
        if self.amplitude == 0.0:
            return sky
        return sky + dipole_alm(self.coordinates(), site.lmax)
