"""Effects whose parameter is a vector: of three components with a direction on the sky, or of any number."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from mcsim.errors import InputError
from mcsim.systematics.base import Effect, Vector


@dataclass(frozen=True, kw_only=True)
class DirectedEffect(Effect):
    """Base of effects whose parameter is a vector in the frame of the maps, fitted in its components x, y and z.

    Attributes
    ----------
    amplitude
        Length.
    lon_deg, lat_deg
        Direction.
    """

    lon_deg: float = 0.0
    lat_deg: float = 0.0

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

    def direction(self) -> str:
        """Return longitude and latitude in the frame of the maps."""
        return f"towards longitude {self.lon_deg:.0f}°, latitude {self.lat_deg:.0f}°".replace("-", "−")


def along(effect: str, key: str, direction: tuple[float, ...], amplitude: float) -> Vector:
    """``amplitude`` times the unit vector along a parameter of an effect; InputError where that is zero."""
    vector = np.array(direction)
    norm = float(np.linalg.norm(vector))
    if norm == 0.0:
        raise InputError(f"effect {effect}: {key} are all zero; give a direction, or amplitude = 0.")
    return np.asarray(amplitude * vector / norm)


def towards(lon_deg: float, lat_deg: float) -> Vector:
    """Return the unit vector towards a longitude and a latitude, in degrees."""
    lon, lat = np.deg2rad([lon_deg, lat_deg])
    return np.array([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])


def lonlat_deg(vector: Vector) -> tuple[float, float]:
    """Longitude in [0, 360) and latitude of a vector, in degrees; (0, 0) of none."""
    x, y, z = (float(component) for component in vector)
    return float(np.rad2deg(np.arctan2(y, x)) % 360.0), float(np.rad2deg(np.arctan2(z, np.hypot(x, y))))
