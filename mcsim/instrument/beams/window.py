"""Beam windows B_l: text tables such as WMAP's, FITS tables such as Planck's, .npy files, arrays."""

import bz2
import gzip
import lzma
import re
import warnings
from pathlib import Path

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from mcsim.errors import InputError
from mcsim.sphere.header import opened
from mcsim.support.arrays import reals
from mcsim.support.folders import unreadable, user_path
from mcsim.support.npy import read_npy

Window = NDArray[np.float64]

COLUMNS = ("BL", "B_L", "INT_BEAM", "NOMINAL", "TEMPERATURE", "T", "BEAM")
"""Names of columns of B_l, the surest first: LFI's instrument model, Planck's CMB maps, HFI's model and windows."""

DEGREES = ("L", "ELL", "MULTIPOLE")
"""Names of columns of ell."""

SQUARED = re.compile(r"(?i)^w_?(l|ell)$|^b_?(l|ell)_?\^?(2|sq|squared)$|_2_")
"""Names of columns of W_l = B_l^2; those of Planck's HFI have _2_ in them."""

_SAID_SQUARED = re.compile(r"(?i)(?<![a-z])(w[_({]*(l|ell)(?![a-z])|b_?\{?(l|ell)\}?\s*(\^|\*\*)\s*\{?2)|squared")

_UNPACK = {".gz": gzip.decompress, ".bz2": bz2.decompress, ".xz": lzma.decompress}  #: of texts that numpy reads packed

LARGEST = 1.05  #: of |B_l| over B_0: more is no beam


def read_window(
    source: str | Path | NDArray, lmax: int | None = None, extension: str | None = None, column: str | None = None
) -> Window:
    """Return B_l from l = 0, shape (lmax + 1,), ``lmax`` None: all of it.

    What is read, and what is refused, says :meth:`mcsim.instrument.beams.Beam.from_window`.
    """
    if not isinstance(source, str | Path):
        found, origin = reals(source, "the array of B_l"), "the array of B_l"
    else:
        path, origin = user_path(source), str(source)
        if path.suffix == ".npy":
            found = read_npy(path, "iuf").astype(np.float64)
        elif _is_fits(path):
            found, origin = _of_fits(path, extension, column)
        else:
            if extension is not None or column is not None:
                raise InputError(f"{path} is no FITS file, so it has no extension or named column; leave these out.")
            found = _of_text(path)
    if found.ndim != 1 or not found.size or not np.all(np.isfinite(found)):
        raise InputError(f"{origin} holds no finite B_l, one for each l; repair it.")
    if abs(found[0] + 1.0) <= 0.01:
        raise InputError(f"{origin} starts at B_0 = {found[0]:g}, so its sign is reversed; multiply it by -1.")
    if abs(found[0] - 1.0) > 0.01 or np.abs(found).max() > LARGEST:
        raise InputError(
            f"{origin} starts at B_0 = {found[0]:g} and reaches {np.abs(found).max():g}, where B_l is 1 at l = 0 and "
            "falls; give B_l, neither its square nor b_l0."
        )
    if lmax is not None and lmax < 0:
        raise InputError(f"lmax = {lmax} of {origin} is negative; give a degree.")
    if lmax is not None and found.size <= lmax:
        raise InputError(
            f"{origin} holds B_l up to l = {found.size - 1}, but l = {lmax} is needed; lower lmax or give a "
            "longer table."
        )
    return found if lmax is None else found[: lmax + 1]


def _is_fits(path: Path) -> bool:
    return path.name.lower().removesuffix(".gz").endswith((".fits", ".fit"))


def _of_text(path: Path) -> Window:
    with unreadable(path, "a table of B_l", "give columns ell and B_l"), warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of an empty file, which is refused
        lines = _UNPACK.get(path.suffix, bytes)(path.read_bytes()).decode("utf-8-sig", "replace")
        table = np.loadtxt(lines.splitlines(), ndmin=2)
        comments = [line.strip() for line in lines.splitlines() if line.lstrip().startswith("#")]
    said = next((line for line in comments if _SAID_SQUARED.search(line)), None)
    if said is not None and not re.search("(?i)ampl", " ".join(comments)):  # that of B_l may say what its square is
        raise InputError(f"{path} says {said[:60]!r}, so it seems to hold W_l = B_l^2; give the file of B_l.")
    if table.shape[1] == 1:
        return np.asarray(table[:, 0])
    _check_counts(table[:, 0], f"{path} (first column)")
    return np.asarray(table[:, 1])


def _check_counts(ell: NDArray, where: str) -> None:
    """Raise InputError unless a column of ell counts from 0: B_l are taken by their place."""
    if not np.array_equal(ell, np.arange(len(ell))):
        raise InputError(f"{where} does not count ell from 0; give every ell from 0 on.")


def holds_window(path: Path) -> bool:
    """Return True if the first table of a FITS file has a single column, and is no map."""
    with unreadable(path, "a FITS file", "give a beam map, b_lm or B_l"), opened(path) as hdus:
        tables = [hdu for hdu in hdus if isinstance(hdu, fits.BinTableHDU | fits.TableHDU)]
        return bool(tables) and len(tables[0].columns) == 1 and "PIXTYPE" not in tables[0].header


def _of_fits(path: Path, extension: str | None, column: str | None) -> tuple[Window, str]:
    """Return B_l and the name of their table."""
    with unreadable(path, "a FITS table of B_l", "give another file"), opened(path) as hdus:
        names = [str(hdu.name).strip() for hdu in hdus]
        tables = {
            name if name and names.count(name) == 1 else str(number): hdu
            for number, (name, hdu) in enumerate(zip(names, hdus, strict=True))
            if isinstance(hdu, fits.BinTableHDU | fits.TableHDU)
        }
        where, field = _chosen(path, tables, extension, column)
        table = tables[where]
        for name in table.columns.names:
            if name.upper() in DEGREES:
                _check_counts(np.ravel(table.data.field(name)), f"{path} ({where}, {name})")
        values = np.asarray(table.data.field(field), dtype=np.float64).ravel()
    return values, f"{path} ({where}, {field})"


def _chosen(
    path: Path, tables: dict[str, fits.BinTableHDU], extension: str | None, column: str | None
) -> tuple[str, str]:
    """Return extension and column with B_l: those asked for, or the only ones that it can be."""
    known = ", ".join(tables) or "none"
    if extension is not None:
        tables = {name: hdu for name, hdu in tables.items() if name.upper() == extension.strip().upper()}
        if not tables:
            raise InputError(f"{path} has no table {extension!r}; use one of {known}.")
    found = []
    for name, hdu in tables.items():
        names = [str(each) for each in hdu.columns.names]
        upper = [each.upper() for each in names]
        wanted = COLUMNS if column is None else (column.strip().upper(),)
        match = [names[upper.index(each)] for each in wanted if each in upper]
        # A HEALPix map has a column TEMPERATURE too. The only column of the only table is what it must be.
        if match and (extension or "PIXTYPE" not in hdu.header):
            found.append((name, match[0]))
        elif column is None and len(tables) == len(names) == 1:
            found.append((name, names[0]))
    if not tables:
        raise InputError(f'{path} has no table of B_l; give one, or a beam map as kind = "map" of a beam.')
    if len(found) != 1:
        columns = "; ".join(f"{name}: {', '.join(map(str, hdu.columns.names))}" for name, hdu in tables.items())
        raise InputError(
            f"{path} has {len(found)} columns that may be B_l ({columns or known}); say which with extension and "
            "column."
        )
    if SQUARED.search(found[0][1]):
        raise InputError(f"{path} holds W_l = B_l^2 in {found[0][1]}; give the file of B_l.")
    return found[0]
