"""A user's own pointing, theta, phi and psi from files and arrays, and its sums per pixel."""

import math
import re
import warnings
from collections.abc import Iterable, Iterator, Sequence
from itertools import takewhile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcsim.errors import InputError
from mcsim.instrument.scan.accumulate import add_sample, pixel_sums
from mcsim.instrument.scan.offsets import add_powers, centres
from mcsim.instrument.scan.pointing import quarter_turns, ring_pixel
from mcsim.sphere.checks import LARGEST_ANGLE, check_nside, check_whole
from mcsim.sphere.header import first_table, radians, stated_frame
from mcsim.support.compiled import njit
from mcsim.support.folders import unreadable, user_path

_ROWS = 1 << 20
_NAMES = ("theta", "phi", "psi")
_LATITUDE_AND_LONGITUDE = (
    re.compile(r"(?i)\b(lat|latitude|dec|declination|el|elevation)\b"),
    re.compile(r"(?i)\b(lon|longitude|ra|az|azimuth)\b"),
)
_LARGEST_COLATITUDE = float(np.float32(math.pi))  #: that of the south pole in single precision, 9e-8 above pi
_ENOUGH_ROWS = 10  #: to tell a column of time from angles


def sums_of_samples(blocks: Iterable[Sequence[NDArray]], nside: int, smax: int, order: int = 1) -> NDArray[np.float64]:
    """Return the sums per pixel (:func:`mcsim.instrument.scan.accumulate.pixel_sums`) of blocks of samples.

    A block is theta, phi, psi in radians, shape (n,) each, as of :func:`blocks_of_files` and :func:`checked_samples`;
    ``order`` is that of the moments of their offsets.
    """
    check_nside(nside)
    check_whole(smax, "smax", 1)
    sums = pixel_sums(nside, smax, order)
    middle = centres(nside) if order > 1 else np.empty((0, 3))
    for theta, phi, psi in blocks:
        _add_angles(theta, phi, psi, nside, smax, order, middle, sums)
    return sums


def blocks_of_files(paths: str | Path | Sequence[str | Path], frame: str) -> Iterator[tuple[NDArray[np.float64], ...]]:
    """Read theta, phi, psi from one file or several, block by block; InputError where they cannot be used."""
    if not isinstance(paths, str | Path) and not paths:
        raise InputError("no pointing file is given; name one or several.")
    for path in [paths] if isinstance(paths, str | Path) else paths:
        yield from _blocks(user_path(path), frame)


def _blocks(path: Path, frame: str) -> Iterator[tuple[NDArray[np.float64], ...]]:
    where = f"pointing file {str(path)!r}"
    with unreadable(where, "samples", "give theta, phi and psi as FITS, .npy, .npz or text"):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            columns, factors = _columns(path, frame)
        size = len(columns[0])
        if any(np.shape(column) != (size,) or np.iscomplexobj(column) for column in columns):
            raise ValueError("its columns are not real and of one length")
        for first in range(0, size, _ROWS):
            block = [np.array(column[first : first + _ROWS], dtype=np.float64) for column in columns]
            yield checked_samples([f * column for f, column in zip(factors, block, strict=True)], where)
    if size == 0:
        raise InputError(f"{where} has no samples; give at least one row.")


def _columns(path: Path, frame: str) -> tuple[list[Any], list[float]]:
    """Return columns theta, phi, psi, mapped into memory where the format allows it, and the factors to radians."""
    factors = [1.0, 1.0, 1.0]
    if path.suffix == ".npz":
        with np.load(path, allow_pickle=False) as archive:
            return [archive[name] for name in _NAMES], factors
    if path.suffix == ".npy":
        array = np.load(path, mmap_mode="r", allow_pickle=False)
        if array.dtype.names is not None:
            return [array[name] for name in _NAMES], factors
    elif path.suffix.lower() in (".fits", ".fit", ".gz"):
        from astropy.io import fits

        with fits.open(path) as hdus:
            table = first_table(hdus)
            stated = stated_frame(hdus, f"pointing file {str(path)!r}")
            if stated not in (None, frame):
                raise InputError(
                    f"pointing file {str(path)!r} is in {stated} coordinates, the maps in {frame}; turn it."
                )
            units = [table.columns[name].unit for name in _NAMES]
            factors = [radians(unit) if unit else 1.0 for unit in units]
            return [table.data[name].ravel() for name in _NAMES], factors
    else:
        _check_header(path)
        array = np.loadtxt(path, ndmin=2, encoding="utf-8-sig")
    if array.ndim != 2 or array.shape[1] not in (3, 4):
        raise ValueError(f"its shape is {array.shape}, not (n, 3) or (n, 4)")
    if array.shape[1] == 4 and len(array) >= _ENOUGH_ROWS and _rises(array[:, 0]) and not _rises(array[:, 3]):
        raise ValueError("its first column rises and its fourth does not: give theta, phi, psi, time, in this order")
    return [array[:, column] for column in range(3)], factors


def _check_header(path: Path) -> None:
    """Raise ValueError if the first lines of a text file name other columns or degrees."""
    with path.open(encoding="utf-8-sig") as stream:
        lines = list(takewhile(lambda line: line.startswith("#"), map(str.lstrip, stream)))
        named = any(set(_NAMES) <= set(re.findall(r"theta|phi|psi", line.lower())) for line in lines)
        for line in lines:
            names = re.findall(r"theta|phi|psi|time", line.lower())
            if not named and all(word.search(line) for word in _LATITUDE_AND_LONGITUDE):
                raise ValueError(f"it says {line.strip()[:60]!r}: give colatitude theta, phi and psi, in this order")
            if set(_NAMES) <= set(names) and tuple(names[:3]) != _NAMES:
                raise ValueError(f"its columns are named {', '.join(names)}: give theta, phi, psi, time, in this order")
            if re.search(r"\bdeg|°", line.lower()):
                raise ValueError(f"it says {line.strip()[:60]!r}: give radians")


def _rises(column: NDArray[np.float64]) -> bool:
    """Return True if the first rows rise, as time does."""
    return bool(np.all(np.diff(np.asarray(column[:_ROWS], dtype=np.float64)) > 0.0))


def checked_samples(columns: Sequence[NDArray[np.float64]], where: str) -> tuple[NDArray[np.float64], ...]:
    """Return theta, phi, psi if they are finite and theta is a colatitude in radians; ``where`` names them."""
    for name, column in zip(_NAMES, columns, strict=True):
        if not np.isfinite(column).all():
            raise InputError(f"{where}: {name} has values that are not finite; leave such samples out.")
    theta, phi, _ = columns
    if theta.size and (theta.min() < 0.0 or theta.max() > _LARGEST_COLATITUDE):
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


@njit(nogil=True, error_model="numpy")
def _add_angles(theta, phi, psi, nside, smax, order, middle, sums):  # type: ignore[no-untyped-def]
    for k in range(theta.size):
        sin_theta = math.sin(theta[k])
        x, y, z = sin_theta * math.cos(phi[k]), sin_theta * math.sin(phi[k]), math.cos(theta[k])
        pixel = ring_pixel(nside, quarter_turns(x, y), x, y, z)
        add_sample(sums, pixel, x, y, z, math.cos(psi[k]), math.sin(psi[k]), smax)
        if order > 1:
            add_powers(sums[pixel], 4 + 2 * smax, order, middle[pixel], x, y, z)
