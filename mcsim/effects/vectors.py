"""Directions in the frame of the maps, for effects whose parameter is a vector."""

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]


def towards(lon_deg: float, lat_deg: float) -> Vector:
    """Unit vector towards a longitude and a latitude, in degrees."""
    lon, lat = np.deg2rad([lon_deg, lat_deg])
    return np.array([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])


def lonlat_deg(vector: Vector) -> tuple[float, float]:
    """Longitude in [0, 360) and latitude of a vector, in degrees; (0, 0) of none."""
    x, y, z = (float(component) for component in vector)
    return float(np.rad2deg(np.arctan2(y, x)) % 360.0), float(np.rad2deg(np.arctan2(z, np.hypot(x, y))))
