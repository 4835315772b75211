"""Coordinate frames that maps may have, and the grid of a map."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mcsim.errors import InputError
from mcsim.sphere.checks import check_nside

FRAMES = {"ecliptic": "E", "galactic": "G", "equatorial": "C"}
"""healpy's letters of the coordinate frames."""


def check_frame(frame: str) -> None:
    """Raise InputError unless ``frame`` is known."""
    if frame not in FRAMES:
        raise InputError(f"frame is {frame!r}, but it must be one of {', '.join(FRAMES)}.")


def check_time_range(time_range: tuple[float, float]) -> None:
    """Raise InputError unless ``time_range`` is an increasing pair within 0 and 1."""
    start, stop = time_range
    if not 0.0 <= start < stop <= 1.0:
        raise InputError(f"time_range is ({start:g}, {stop:g}), but it must be an increasing pair within 0 and 1.")


@dataclass(frozen=True)
class MapGrid:
    """The pixels of a map, and the part of a survey that is binned into them.

    Parameters
    ----------
    nside
        HEALPix resolution.
    frame
        Frame of the pixels: "ecliptic", "galactic" or "equatorial".
    time_range
        Part of the survey, as fractions of its samples: (0, 0.5) is the first half.
    """

    nside: int
    frame: str = "ecliptic"
    time_range: tuple[float, float] = (0.0, 1.0)

    def __post_init__(self) -> None:
        """Raise InputError for an nside that is no power of two, an unknown frame, or no increasing time range."""
        check_nside(self.nside)
        check_frame(self.frame)
        check_time_range(self.time_range)

    @property
    def npix(self) -> int:
        """Number of pixels."""
        return 12 * self.nside * self.nside


def frame_matrix(frame: str) -> NDArray[np.float64]:
    """Return the rotation matrix, shape (3, 3), from ecliptic vectors to vectors of ``frame`` (J2000)."""
    check_frame(frame)
    if frame == "ecliptic":
        return np.eye(3)
    import healpy

    return np.ascontiguousarray(healpy.Rotator(coord=["E", FRAMES[frame]]).mat)
