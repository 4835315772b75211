"""Coordinate frames and pixel resolutions that maps may have."""

import math

import numpy as np
from numpy.typing import NDArray

from mcsim.errors import InputError

FRAMES = {"ecliptic": "E", "galactic": "G", "equatorial": "C"}
"""healpy's letters of the coordinate frames."""

NSIDE_MAX = 8192


def check_frame(frame: str) -> None:
    """Raise InputError unless ``frame`` is known."""
    if frame not in FRAMES:
        raise InputError(f"frame is {frame!r}, but it must be one of {', '.join(FRAMES)}.")


def check_nside(nside: int) -> None:
    """Raise InputError unless ``nside`` is a power of two between 1 and NSIDE_MAX."""
    if nside < 1 or nside > NSIDE_MAX or nside & (nside - 1):
        raise InputError(f"nside is {nside}, but it must be a power of two between 1 and {NSIDE_MAX}.")


def nside_of(npix: int, where: str) -> int:
    """Resolution of a full sky of ``npix`` pixels; ``where`` names it in the InputError raised if there is none."""
    nside = math.isqrt(max(npix, 0) // 12)
    if nside == 0 or 12 * nside * nside != npix or nside & (nside - 1):
        raise InputError(f"{where} has {npix} pixels, which is no full HEALPix sky; write all 12 nside^2 pixels.")
    return nside


def frame_matrix(frame: str) -> NDArray[np.float64]:
    """Rotation matrix, shape (3, 3), from ecliptic vectors to vectors of ``frame`` (J2000)."""
    check_frame(frame)
    if frame == "ecliptic":
        return np.eye(3)
    import healpy

    return np.ascontiguousarray(healpy.Rotator(coord=["E", FRAMES[frame]]).mat)
