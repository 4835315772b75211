"""Angular power spectra C_l in uK^2, from a packaged name, a text table or a FITS file."""

import gzip
import io
import re
import warnings
import zlib
from pathlib import Path

import numpy as np
from astropy.io import fits
from astropy.utils.exceptions import AstropyUserWarning
from numpy.typing import NDArray

from mcsim.errors import InputError
from mcsim.support import resources
from mcsim.support.npy import read_npy

# Names of D_l = l(l+1) C_l / 2 pi as they stand in headers: D_l, Dl, D_ell, D_{\ell}, l(l+1)Cl.
_NAMES_OF_D_L = re.compile(r"(?i)\bD_?\{?\\?(l|ell)\b|(l|ell)\s*\*?\s*\((l|ell)\s*\+\s*1\)")

_TO_UK2 = {"uk2": 1.0, "muk2": 1.0, "microk2": 1.0, "mk2": 1e6, "k2": 1e12}


def load(spec: str | Path, lmax: int) -> NDArray[np.float64]:
    """Read a temperature power spectrum.

    Parameters
    ----------
    spec
        A packaged name (``"wmap7"``, ``"planck2018"``); or a text table of the two columns ell, C_ell [uK^2] (``#``
        starts a header line; rows in any order, complete from ell = 2; ell = 0 and 1 may be absent and are zero
        then); or a FITS file as ``healpy.read_cl`` reads: a table in the first extension whose first column is TT
        from ell = 0; or a .npy file of C_l in uK^2 from ell = 0.
    lmax
        Highest degree wanted, >= 0.

    Returns
    -------
    ndarray
        C_l in uK^2 for l = 0..lmax, shape (lmax + 1,).

    Raises
    ------
    InputError
        No such file, an unreadable one, a header that names D_l, an unknown unit, a table that ends below lmax or has
        gaps, a value that is not finite or is negative.

    Notes
    -----
    The unit of a FITS column is its TUNIT1: uK^2, mK^2 and K^2 are converted (a CMB marker such as uK_CMB^2 is
    understood); a column without unit is taken to be in uK^2. The packaged tables reach l = 4096; their parameters
    and accuracy stand in ``workflows/spectra/make_spectra.py``.
    """
    path = resources.spectrum(spec)
    if path.suffix == ".npy":
        cl = read_npy(path, "iuf").astype(np.float64)
    else:
        cl = _read_fits(path) if path.name.removesuffix(".gz").endswith((".fits", ".fit")) else _read_text(path)
    if len(cl) <= lmax:
        raise InputError(
            f"power spectrum {str(spec)!r} ends at l = {len(cl) - 1}, but lmax = {lmax} is wanted; "
            "lower lmax or give a longer table."
        )
    cl = cl[: lmax + 1]
    for bad, what in ((~np.isfinite(cl), "not finite"), (cl < 0.0, "negative")):
        if bad.any():
            ell = int(np.argmax(bad))
            raise InputError(
                f"power spectrum {str(spec)!r} has C_l = {cl[ell]:g} at l = {ell}, which is {what}; correct the table."
            )
    return cl


def _refuse_d_l(path: Path, header: str) -> None:
    if _NAMES_OF_D_L.search(header):
        raise InputError(
            f"power spectrum {str(path)!r} says {header.strip()[:60]!r}, so it seems to hold D_l = l(l+1) C_l / 2 pi, "
            "but C_l in uK^2 is wanted; divide by l(l+1) / 2 pi and name the columns 'ell, C_ell [uK^2]'."
        )


def _contents(path: Path) -> bytes:
    contents = path.read_bytes()
    return gzip.decompress(contents) if path.suffix == ".gz" else contents


def _read_text(path: Path) -> NDArray[np.float64]:
    try:
        lines = _contents(path).decode().splitlines()
    except (OSError, EOFError, zlib.error, UnicodeDecodeError) as error:
        raise InputError(
            f"power spectrum {str(path)!r} cannot be read as text ({error}); give a text table or a FITS file."
        ) from None
    found: dict[int, float] = {}
    for number, line in enumerate(lines, start=1):
        row = line.strip()
        if row.startswith("#"):
            _refuse_d_l(path, row)
            continue
        if not row:
            continue
        try:
            ell, value = (float(word) for word in row.replace(",", " ").split())
            degree = int(ell)
            if degree != ell or degree < 0 or degree in found:
                raise ValueError
        except (ValueError, OverflowError):
            raise InputError(
                f"power spectrum {str(path)!r}, line {number}: {row[:60]!r} is not a row of the two columns ell, "
                "C_ell [uK^2] with a whole ell >= 0 that occurs once; correct it or start it with '#'."
            ) from None
        found[degree] = value
    if not found:
        raise InputError(f"power spectrum {str(path)!r} has no rows; give the two columns ell, C_ell [uK^2].")
    gap = next((ell for ell in range(2, max(found)) if ell not in found), None)
    if gap is not None:
        raise InputError(
            f"power spectrum {str(path)!r} has no row for ell = {gap}; give every ell from 2 to its last one."
        )
    cl = np.zeros(max(found) + 1)
    cl[list(found)] = list(found.values())
    return cl


def _read_fits(path: Path) -> NDArray[np.float64]:
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("error", ".*truncated.*", AstropyUserWarning)
            with fits.open(io.BytesIO(_contents(path))) as hdus:
                header = hdus[1].header
                cl = np.ravel(np.ma.filled(hdus[1].data.field(0), np.nan)).astype(np.float64)
    except Exception as error:  # libraries raise whatever a broken file makes of them
        raise InputError(
            f"power spectrum {str(path)!r} cannot be read as a FITS table ({error}); "
            "give a file as healpy.write_cl writes it."
        ) from None
    _refuse_d_l(path, str(header.get("TTYPE1", "")))
    unit = str(header.get("TUNIT1", "")).strip()
    if not unit:
        return cl
    key = re.sub(r"[\s^_*()]|cmb", "", unit.lower().replace("µ", "u").replace("μ", "u"))
    if key not in _TO_UK2:
        raise InputError(
            f"power spectrum {str(path)!r} has the unit {unit!r}; convert it to uK^2 (mK^2 and K^2 are read too)."
        )
    return cl * _TO_UK2[key]
