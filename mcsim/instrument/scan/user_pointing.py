"""A user's own pointing, theta, phi and psi from files and arrays, and its sums per pixel."""

import math
import warnings
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mcsim.errors import InputError
from mcsim.instrument.scan.accumulate import add_sample, pixel_sums
from mcsim.instrument.scan.geometry import check_nside
from mcsim.instrument.scan.pointing import quarter_turns, ring_pixel

_ROWS = 1 << 20
_NAMES = ("theta", "phi", "psi")


def sums_of_samples(blocks: Iterable[Sequence[NDArray]], nside: int, smax: int) -> NDArray[np.float64]:
    """Return the sums per pixel, as of :func:`mcsim.instrument.scan.accumulate.pixel_sums`, of blocks of samples.

    Parameters
    ----------
    blocks
        theta, phi, psi in radians, shape (n,) each, as :func:`blocks_of_files` and :func:`checked_samples` give them.
    nside, smax
        HEALPix resolution, and largest s (>= 1).

    Raises
    ------
    InputError
        If nside or smax is out of range.
    """
    check_nside(nside)
    if smax < 1:
        raise InputError(f"smax is {smax}, but moments need smax >= 1.")
    sums = pixel_sums(nside, smax)
    for theta, phi, psi in blocks:
        _add_angles(theta, phi, psi, nside, smax, sums)
    return sums


def blocks_of_files(paths: str | Path | Sequence[str | Path]) -> Iterator[tuple[NDArray[np.float64], ...]]:
    """Read theta, phi, psi from one file or several, block by block; InputError where they cannot be used."""
    for path in [paths] if isinstance(paths, str | Path) else paths:
        yield from _blocks(Path(path))


def _blocks(path: Path) -> Iterator[tuple[NDArray[np.float64], ...]]:
    where = f"pointing file {str(path)!r}"
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            columns = _columns(path)
        size = min(len(column) for column in columns)
        for first in range(0, size, _ROWS):
            yield checked_samples(
                [np.array(column[first : first + _ROWS], dtype=np.float64) for column in columns], where
            )
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


def checked_samples(columns: Sequence[NDArray[np.float64]], where: str) -> tuple[NDArray[np.float64], ...]:
    """Return theta, phi, psi if they are finite and theta is a colatitude in radians; ``where`` names them."""
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
