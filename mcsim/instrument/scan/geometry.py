"""Coordinate frames that maps may have."""

import numpy as np
from numpy.typing import NDArray

from mcsim.errors import InputError

FRAMES = {"ecliptic": "E", "galactic": "G", "equatorial": "C"}
"""healpy's letters of the coordinate frames."""


def check_frame(frame: str) -> None:
    """Raise InputError unless ``frame`` is known."""
    if frame not in FRAMES:
        raise InputError(f"frame is {frame!r}, but it must be one of {', '.join(FRAMES)}.")


def frame_matrix(frame: str) -> NDArray[np.float64]:
    """Rotation matrix, shape (3, 3), from ecliptic vectors to vectors of ``frame`` (J2000)."""
    check_frame(frame)
    if frame == "ecliptic":
        return np.eye(3)
    import healpy

    return np.ascontiguousarray(healpy.Rotator(coord=["E", FRAMES[frame]]).mat)
