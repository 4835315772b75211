"""Orientation moments of a user's own pointing: files of theta, phi, psi and, if they like, time."""

import math
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mcsim.errors import InputError
from mcsim.instrument.scan.accumulate import add_sample, moments_from_sums, pixel_sums
from mcsim.instrument.scan.geometry import check_frame
from mcsim.instrument.scan.moments import Moments
from mcsim.instrument.scan.pointing import quarter_turns, ring_pixel
from mcsim.sphere.checks import check_nside, check_whole

_ROWS = 1 << 20
_NAMES = ("theta", "phi", "psi")


def pointing_moments(
    paths: str | Path | Sequence[str | Path], nside: int, smax: int, frame: str = "ecliptic"
) -> Moments:
    """Orientation moments of samples that are given one by one in files.

    Parameters
    ----------
    paths
        One file or several, added up. Columns theta, phi, psi in radians, in the frame of the maps, and
        optionally time, which the moments do not need: a FITS binary table or a .npz file with these names, a .npy
        file (structured with these names, or of shape (n, 3) or (n, 4)), or text of 3 or 4 columns.
    nside, smax
        HEALPix resolution, and largest s (>= 1).
    frame
        Frame of the pointing and of the maps.

    Raises
    ------
    InputError
        If a file cannot be read, lacks a column, is empty, or has a value that is not finite or a theta outside
        0 to pi.
    """
    check_nside(nside)
    check_frame(frame)
    check_whole(smax, "smax", 1)
    sums = pixel_sums(nside, smax)
    for path in [paths] if isinstance(paths, str | Path) else paths:
        for theta, phi, psi in _blocks(Path(path)):
            _add_angles(theta, phi, psi, nside, smax, sums)
    return moments_from_sums(sums, nside, smax, frame)


def _blocks(path: Path) -> Iterator[tuple[NDArray[np.float64], ...]]:
    where = f"pointing file {str(path)!r}"
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            columns = _columns(path)
        size = min(len(column) for column in columns)
        for first in range(0, size, _ROWS):
            yield _checked([np.array(column[first : first + _ROWS], dtype=np.float64) for column in columns], where)
    except InputError:
        raise
    except Exception as error:  # libraries raise whatever a broken file makes of them
        raise InputError(
            f"{where} cannot be read: {error}; give theta, phi and psi as FITS, .npy, .npz or text."
        ) from None
    if size == 0:
        raise InputError(f"{where} has no samples; give at least one row.")


def _columns(path: Path) -> list[Any]:
    """Columns theta, phi, psi, mapped into memory where the format allows it."""
    if path.suffix == ".npz":
        with np.load(path, allow_pickle=False) as archive:
            return [archive[name] for name in _NAMES]
    if path.suffix == ".npy":
        array = np.load(path, mmap_mode="r", allow_pickle=False)
        if array.dtype.names is not None:
            return [array[name] for name in _NAMES]
    elif path.suffix in (".fits", ".fit", ".gz"):
        from astropy.io import fits

        with fits.open(path) as hdus:
            table = next((hdu for hdu in hdus if isinstance(hdu, fits.BinTableHDU)), None)
            if table is None:
                raise ValueError("it has no binary table")
            return [table.data[name].ravel() for name in _NAMES]
    else:
        array = np.loadtxt(path, ndmin=2)
    if array.ndim != 2 or array.shape[1] not in (3, 4):
        raise ValueError(f"its shape is {array.shape}, not (n, 3) or (n, 4)")
    return [array[:, column] for column in range(3)]


def _checked(columns: list[NDArray[np.float64]], where: str) -> tuple[NDArray[np.float64], ...]:
    for name, column in zip(_NAMES, columns, strict=True):
        if not np.isfinite(column).all():
            raise InputError(f"{where}: {name} has values that are not finite; leave such samples out.")
    theta = columns[0]
    if theta.size and (theta.min() < 0.0 or theta.max() > math.pi):
        raise InputError(
            f"{where}: theta runs from {theta.min():g} to {theta.max():g}, but it must lie between 0 and pi; "
            "give colatitudes in radians."
        )
    return tuple(columns)


@njit(cache=True, nogil=True, error_model="numpy")
def _add_angles(theta, phi, psi, nside, smax, sums):  # type: ignore[no-untyped-def]
    for k in range(theta.size):
        sin_theta = math.sin(theta[k])
        x, y, z = sin_theta * math.cos(phi[k]), sin_theta * math.sin(phi[k]), math.cos(theta[k])
        add_sample(
            sums, ring_pixel(nside, quarter_turns(x, y), x, y, z), x, y, z, math.cos(psi[k]), math.sin(psi[k]), smax
        )
