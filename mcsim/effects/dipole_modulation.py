"""A sky with more power on one side."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from mcsim.effects.base import Alm, Draw, Effect, Site, Vector
from mcsim.effects.product import multiplied
from mcsim.effects.vectors import lonlat_deg, towards


@dataclass(frozen=True, kw_only=True)
class DipoleModulation(Effect):
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
    own_score = False

    lon_deg: float = 0.0
    lat_deg: float = 0.0

    def sky(self, sky: Alm, site: Site, draw: Draw) -> Alm:
        """Modulated."""
        if self.amplitude == 0.0:
            return sky
        a, b, c = self.coordinates()
        return sky + multiplied(sky, site.lmax, lambda x, y, z: a * x + b * y + c * z, 1)

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
