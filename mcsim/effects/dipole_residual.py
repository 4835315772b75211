"""A dipole that was not all taken off."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from mcsim.effects.base import Alm, Draw, Effect, Site, Vector
from mcsim.effects.vectors import lonlat_deg, towards
from mcsim.tod import dipole_alm


@dataclass(frozen=True, kw_only=True)
class DipoleResidual(Effect):
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
    own_score = False

    lon_deg: float = 0.0
    lat_deg: float = 0.0

    def sky(self, sky: Alm, site: Site, draw: Draw) -> Alm:
        """With the dipole added."""
        if self.amplitude == 0.0:
            return sky
        return sky + dipole_alm(self.coordinates(), site.lmax)

    @classmethod
    def basis(cls) -> tuple[Self, ...]:
        """Along x, y and z."""
        return (cls(amplitude=cls.step), cls(amplitude=cls.step, lon_deg=90.0), cls(amplitude=cls.step, lat_deg=90.0))

    def coordinates(self) -> Vector:
        """Components x, y, z."""
        return self.amplitude * towards(self.lon_deg, self.lat_deg)

    @classmethod
    def nearest(cls, coordinates: Vector, precision: NDArray[np.float64]) -> Self:
        """Norm and direction."""
        lon_deg, lat_deg = lonlat_deg(coordinates)
        return cls(amplitude=float(np.linalg.norm(coordinates)), lon_deg=lon_deg, lat_deg=lat_deg)
