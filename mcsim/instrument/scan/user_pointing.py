"""Orientation moments of a user's own pointing: files of theta, phi, psi and, if they like, time."""

import math
import re
import warnings
from collections.abc import Iterator, Sequence
from itertools import takewhile
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
from mcsim.sphere.checks import LARGEST_ANGLE, check_nside, check_whole
from mcsim.sphere.header import frame_named, radians

_ROWS = 1 << 20
_NAMES = ("theta", "phi", "psi")
_ENOUGH_ROWS = 10
"""To tell a column of time from angles."""


def pointing_moments(
    paths: str | Path | Sequence[str | Path], nside: int, smax: int, frame: str = "ecliptic"
) -> Moments:
    """Orientation moments of samples that are given one by one in files.

    Parameters
    ----------
    paths
        One file or several, added up. Columns theta, phi, psi in radians (FITS: in the unit that TUNIT states, if it
        does), in the frame of the maps, and optionally time, which the moments do not need: a FITS binary table or a
        .npz file with these names, a .npy file (structured with these names, or of shape (n, 3) or (n, 4)), or text of
        3 or 4 columns.
    nside, smax
        HEALPix resolution, and largest s (>= 1).
    frame
        Frame of the pointing and of the maps.

    Raises
    ------
    InputError
        If a file cannot be read, lacks a column, has columns of several lengths or in another order, is in another
        frame, is empty, or has a value that is not real and finite, a theta outside 0 to pi, or a phi or psi beyond
        two turns.
    """
    check_nside(nside)
    check_frame(frame)
    check_whole(smax, "smax", 1)
    sums = pixel_sums(nside, smax)
    for path in [paths] if isinstance(paths, str | Path) else paths:
        for theta, phi, psi in _blocks(Path(path), frame):
            _add_angles(theta, phi, psi, nside, smax, sums)
    return moments_from_sums(sums, nside, smax, frame)


def _blocks(path: Path, frame: str) -> Iterator[tuple[NDArray[np.float64], ...]]:
    where = f"pointing file {str(path)!r}"
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            columns, factors = _columns(path, frame)
        size = len(columns[0])
        if any(np.shape(column) != (size,) or np.iscomplexobj(column) for column in columns):
            raise ValueError("its columns are not real and of one length")
        for first in range(0, size, _ROWS):
            block = [np.array(column[first : first + _ROWS], dtype=np.float64) for column in columns]
            yield _checked([f * column for f, column in zip(factors, block, strict=True)], where)
    except InputError:
        raise
    except Exception as error:  # libraries raise whatever a broken file makes of them
        raise InputError(
            f"{where} cannot be read: {error}; give theta, phi and psi as FITS, .npy, .npz or text."
        ) from None
    if size == 0:
        raise InputError(f"{where} has no samples; give at least one row.")


def _columns(path: Path, frame: str) -> tuple[list[Any], list[float]]:
    """Columns theta, phi, psi, mapped into memory where the format allows it, and the factors to radians."""
    factors = [1.0, 1.0, 1.0]
    if path.suffix == ".npz":
        with np.load(path, allow_pickle=False) as archive:
            return [archive[name] for name in _NAMES], factors
    if path.suffix == ".npy":
        array = np.load(path, mmap_mode="r", allow_pickle=False)
        if array.dtype.names is not None:
            return [array[name] for name in _NAMES], factors
    elif path.suffix in (".fits", ".fit", ".gz"):
        from astropy.io import fits

        with fits.open(path) as hdus:
            table = next((hdu for hdu in hdus if isinstance(hdu, fits.BinTableHDU)), None)
            if table is None:
                raise ValueError("it has no binary table")
            stated = frame_named(table.header.get("COORDSYS"), f"pointing file {str(path)!r}")
            if stated not in (None, frame):
                raise InputError(
                    f"pointing file {str(path)!r} is in {stated} coordinates, the maps in {frame}; turn it."
                )
            units = [table.columns[name].unit for name in _NAMES]
            factors = [radians(unit) if unit else 1.0 for unit in units]
            return [table.data[name].ravel() for name in _NAMES], factors
    else:
        _check_header(path)
        array = np.loadtxt(path, ndmin=2)
    if array.ndim != 2 or array.shape[1] not in (3, 4):
        raise ValueError(f"its shape is {array.shape}, not (n, 3) or (n, 4)")
    if array.shape[1] == 4 and len(array) >= _ENOUGH_ROWS and _rises(array[:, 0]) and not _rises(array[:, 3]):
        raise ValueError("its first column rises and its fourth does not: give theta, phi, psi, time, in this order")
    return [array[:, column] for column in range(3)], factors


def _check_header(path: Path) -> None:
    """Raise ValueError if the first lines of a text file name other columns or degrees."""
    with path.open(encoding="utf-8") as stream:
        for line in takewhile(lambda line: line.startswith("#"), stream):
            names = re.findall(r"theta|phi|psi|time", line.lower())
            if set(_NAMES) <= set(names) and tuple(names[:3]) != _NAMES:
                raise ValueError(f"its columns are named {', '.join(names)}: give theta, phi, psi, time, in this order")
            if re.search(r"\bdeg|°", line.lower()):
                raise ValueError(f"it says {line.strip()[:60]!r}: give radians")


def _rises(column: NDArray[np.float64]) -> bool:
    """Whether the first rows rise, as time does."""
    return bool(np.all(np.diff(np.asarray(column[:_ROWS], dtype=np.float64)) > 0.0))


def _checked(columns: list[NDArray[np.float64]], where: str) -> tuple[NDArray[np.float64], ...]:
    for name, column in zip(_NAMES, columns, strict=True):
        if not np.isfinite(column).all():
            raise InputError(f"{where}: {name} has values that are not finite; leave such samples out.")
    theta, phi, _ = columns
    if theta.size and (theta.min() < 0.0 or theta.max() > math.pi):
        exchanged = min(theta.min(), phi.min()) >= 0.0 and phi.max() <= math.pi and theta.max() <= 2.0 * math.pi
        remedy = "the columns theta and phi seem to be exchanged" if exchanged else "give colatitudes in radians"
        raise InputError(
            f"{where}: theta runs from {theta.min():g} to {theta.max():g}, but it must lie between 0 and pi; {remedy}."
        )
    for name, column in zip(_NAMES, columns, strict=True):
        if column.size and max(-column.min(), column.max()) > LARGEST_ANGLE:
            raise InputError(
                f"{where}: {name} runs from {column.min():g} to {column.max():g}, but it must lie within two turns; "
                "give radians, or a unit of the column in FITS, and reduce angles modulo 2 pi."
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
