"""HEALPix maps in FITS and .npy files: their columns, orders of pixels, frames and units."""

import os
import warnings
from pathlib import Path

import healpy
import numpy as np
from astropy.io import fits
from astropy.utils.exceptions import AstropyUserWarning
from numpy.typing import NDArray

from mcsim.errors import InputError
from mcsim.sphere.checks import UNSEEN_BELOW, check_not_infinite
from mcsim.sphere.header import SILENT, first_table, opened, stated_frame, to_uk
from mcsim.sphere.pixel_order import check_ring
from mcsim.support.arrays import Map
from mcsim.support.folders import unreadable
from mcsim.support.npy import read_npy

TEMPERATURE = ("TEMPERATURE", "I_STOKES", "TEMP", "INTENSITY", "I")
"""Names of columns with the temperature, in the maps of WMAP, Planck and others."""

HITS = ("N_OBS", "HITS", "NOBS", "HIT", "NHITS")
"""Names of columns with the number of observations, in the maps of WMAP, Planck and others."""

VARIANCE = ("II_COV", "VARIANCE", "I_VAR", "COV_II", "VAR_I", "VAR")
"""Names of columns with the variance of the temperature."""

WEIGHT = ("WEIGHT", "WEIGHTS", "IVAR", "INV_VAR", "INVVAR", "INVERSE_VARIANCE", "I_IVAR", "II_IVAR")
"""Names of columns with what grows as a variance falls."""

DEVIATION = ("SIGMA", "SIGMA_I", "RMS", "STD", "STDDEV", "ERR", "ERROR", "I_ERR")
"""Names of columns with standard deviations of the temperature."""

PIXEL = ("PIXEL", "PIX", "IPIX")
"""Names of columns with the numbers of the pixels."""

POLARISATION = tuple(f"{stokes}{end}" for stokes in "QU" for end in ("", "_STOKES", "_POLARISATION", "_POLARIZATION"))
"""Names of columns with Stokes parameters other than the temperature, in the maps of Planck and of healpy."""


def read_map(
    path: Path,
    names: tuple[str, ...] = (),
    frame: str | None = None,
    bad: float = healpy.UNSEEN,
    alone: bool = True,
    other: tuple[str, ...] = (),
    any_order: bool = False,
) -> tuple[Map, str | None, str | None]:
    """Read a map of a HEALPix FITS file in RING order, and its frame and unit if the header has them.

    It is the column that is called one of ``names``; without names the temperature, or else the first column. A file
    with a single column need not name it, unless it holds something else: its temperature, which was read already
    (``alone`` False), or what its name, one of ``other``, says. Pixels of the value that the header of the table, or
    else of the file, calls BAD_DATA become ``bad``, those of a column's TNULL and those that a table with pixel numbers
    does not list UNSEEN. A .npy file holds an array of shape (npix,) in RING order; its frame and unit are None. Raise
    InputError if the file cannot be read as a HEALPix map, does not say whether it is RING or NESTED, is smooth in the
    other order alone (unless ``any_order``), names an unknown frame, or another one than ``frame``, or has a BAD_DATA
    that is no number.
    """
    if path.suffix == ".npy":
        array = read_npy(path, "biuf").astype(np.float64)
        if not alone:
            raise InputError(f"in {path} nothing is called {' or '.join(names)}; give that in another file.")
        if not healpy.isnpixok(array.size):
            raise InputError(f"{path} has {array.size} pixels, which is no HEALPix map; give all 12 nside^2 pixels.")
        if not any_order:
            check_ring(array, str(path))
        return array, None, None
    if not os.path.exists(path):
        raise InputError(f"{path} does not exist; give a HEALPix map in FITS.")
    with unreadable(path, "a HEALPix map", "give a complete FITS map"), warnings.catch_warnings():
        warnings.simplefilter("error", category=AstropyUserWarning)
        with opened(path) as hdus:
            table = first_table(hdus)
            place, number = _columns_of(path, table, names, alone, other)
            map_ = _in_ring_order(path, table, place, number)
            keywords, found = table.header, stated_frame(hdus, str(path))
            bad_data = keywords.get("BAD_DATA", hdus[0].header.get("BAD_DATA"))
    stated = (f"TUNIT{number + 1}", *(() if names else ("BUNIT", "UNITS")))  # these are of temperatures
    said = (str(keywords.get(key, "")).strip() for key in stated)
    unit = next((word for word in said if word.lower() not in SILENT), None)
    if str(keywords.get("TEMPTYPE", "")).strip().upper().startswith("ANT"):
        unit = f"{unit or 'K'} antenna"
    if frame is not None and found not in (None, frame):
        raise InputError(
            f'{path} is in {found} coordinates, but it is needed in {frame} ones; set map.frame = "{found}", so that '
            "the scan and the noise are computed there, or rotate it."
        )
    map_ = _replaced(map_, bad_data, bad, path)
    if not any_order:
        check_ring(map_, str(path))
    return map_, found, unit


def _replaced(map_: Map, stated: object, bad: float, path: Path) -> Map:
    """Return a map with ``bad`` for the BAD_DATA of its header (None: no such keyword), equal in single precision."""
    if stated is None:
        return map_
    try:
        value = float(str(stated))
    except ValueError:
        raise InputError(
            f"{path} has BAD_DATA = {stated!r}, which is no number; give the value of bad pixels."
        ) from None
    with np.errstate(over="ignore"):
        return np.where(map_.astype(np.float32) == np.float32(value), bad, map_)


def read_uk(path: Path, frame: str, frequency_ghz: float | None) -> Map:
    """Read a map of temperatures as :func:`read_uk_and_unit` does."""
    return read_uk_and_unit(path, frame, frequency_ghz)[0]


def read_uk_and_unit(path: Path, frame: str, frequency_ghz: float | None) -> tuple[Map, str | None]:
    """Read a map of temperatures, uK, in RING order, and the unit that it states; what was not observed stays as it is.

    Raise InputError as :func:`read_map` does, if the header names a unit that cannot be converted, or if pixels are
    infinite.
    """
    map_, _, unit = read_map(path, frame=frame, other=(*HITS, *VARIANCE, *POLARISATION, *WEIGHT, *DEVIATION))
    check_not_infinite(map_, str(path))
    return np.where(map_ > UNSEEN_BELOW, to_uk(unit, path, frequency_ghz) * map_, map_), unit


def _columns_of(
    path: Path, table: fits.BinTableHDU | fits.TableHDU, names: tuple[str, ...], alone: bool, other: tuple[str, ...]
) -> tuple[int | None, int]:
    """Return the places of the columns of pixel numbers, None without one, and of the map called one of ``names``.

    Without names it is that of temperature, or else the first one.
    """
    columns = [str(name).strip().upper() for name in table.columns.names]
    scheme, extent = (str(table.header.get(key, "")).strip().upper() for key in ("INDXSCHM", "OBJECT"))
    place = next((number for number, name in enumerate(columns) if name in PIXEL), None)
    if place is None and (scheme == "EXPLICIT" or (scheme != "IMPLICIT" and extent == "PARTIAL")):
        place = 0
    maps = {name: number for number, name in reversed(list(enumerate(columns))) if number != place}
    for name in names or TEMPERATURE:
        if name in maps:
            return place, maps[name]
    first = min(maps.values(), default=None)
    if first is not None and ((len(maps) == 1 and alone) or not names) and columns[first] not in other:
        return place, first
    names = names or TEMPERATURE
    raise InputError(
        f"{path} has the columns {', '.join(columns)} and none called {' or '.join(names)}; give that under such a "
        "name."
    )


def _in_ring_order(path: Path, table: fits.BinTableHDU | fits.TableHDU, place: int | None, number: int) -> Map:
    """Return a column of a table as a whole map in RING order, ``healpy.UNSEEN`` where it has no value."""
    header, column = table.header, table.columns[number]
    order = str(header.get("ORDERING", "")).strip().upper()
    if order not in ("RING", "NESTED", "NEST"):
        raise InputError(f"{path} does not say how its pixels are ordered; write ORDERING = RING or NESTED there.")
    values = np.ravel(table.data.field(number))
    if values.dtype.kind not in "biuf":
        raise InputError(f"{path} has no real numbers in its column {column.name}; give a map.")
    map_ = values.astype(np.float64)
    if isinstance(column.null, int | np.integer):
        map_[map_ == column.null * (column.bscale or 1.0) + (column.bzero or 0.0)] = healpy.UNSEEN
    stated = header.get("NSIDE")
    if stated is None and place is not None:
        raise InputError(f"{path} has pixel numbers, but no NSIDE; write it into the header of the table.")
    npix = map_.size if stated is None else 12 * int(stated) ** 2
    if place is not None:
        map_ = _whole(path, np.ravel(table.data.field(place)), map_, npix)
    if map_.size != npix or not healpy.isnpixok(npix):
        states = "no NSIDE" if stated is None else f"NSIDE = {stated}, which is of {npix} pixels,"
        raise InputError(
            f"{path} has {map_.size} pixels and {states} in its header; give all 12 nside^2 pixels, or their numbers "
            "in a column PIXEL."
        )
    map_[healpy.mask_bad(map_)] = healpy.UNSEEN  # in single precision too
    return map_ if order == "RING" else np.asarray(healpy.reorder(map_, n2r=True))


def _whole(path: Path, pixels: NDArray, values: Map, npix: int) -> Map:
    """Return a map of ``npix`` pixels with the values of those that are listed; InputError for what lists no pixels."""
    wrong = pixels.size != values.size or pixels.dtype.kind not in "iuf" or not np.all(pixels == np.floor(pixels))
    if wrong or (pixels.size and not 0 <= pixels.min() <= pixels.max() < npix):
        extent = "" if wrong else f", but {int(pixels.min())} to {int(pixels.max())}"
        raise InputError(
            f"{path} has pixel numbers that are not whole ones from 0 to {npix - 1}, one for each value{extent}; "
            "correct them or NSIDE."
        )
    listed = pixels.astype(np.int64)
    twice = np.flatnonzero(np.bincount(listed, minlength=1) > 1)
    if twice.size:
        raise InputError(f"{path} lists pixel {twice[0]} more than once ({twice.size} such pixels); list each once.")
    map_ = np.full(npix, healpy.UNSEEN)
    map_[listed] = values
    return map_
