"""FITS files: opened so that a broken one is an error; units of temperature and coordinate frames in their headers."""

import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import healpy
import numpy as np
from astropy.io import fits
from astropy.utils.exceptions import AstropyUserWarning

from mcsim.errors import InputError
from mcsim.support.arrays import Alm
from mcsim.support.folders import unreadable

T_CMB_K = 2.7255  #: temperature of the CMB (Fixsen 2009, ApJ 707, 916)

_PREFIXES = {"": 1e6, "m": 1e3, "milli": 1e3, "u": 1.0, "mu": 1.0, "micro": 1.0, "n": 1e-3, "nano": 1e-3}
_CMB = r"cmb|thermo(?:dynamic)?"
_RJ = r"rj|a|ant(?:enna)?|rayleigh[\s_-]*jeans|b|brightness"
_KELVIN = re.compile(
    rf"(milli|micro|nano|mu|m|u|n|)[\s_-]*(?:kelvin|k)[\W_]*(?:({_CMB})|({_RJ}))?(?:[\W_]*temp\w*)?\W*"
)
# Of a base that ends without a sign, for K^-2 is no square.
_SQUARE = re.compile(r"(?!1\s*/)\(?([^()]*?[^()\s^*+/−-])\)?\s*(?:\^|\*\*)?\s*\(?2\)?")
SILENT = {"", "unknown", "none", "n/a", "undefined"}  #: words of a header that say nothing

_FRAMES = {
    "ecliptic": ("e", "ecl", "ecliptic"),
    "galactic": ("g", "gal", "galactic"),
    "equatorial": ("c", "q", "cel", "celestial", "equ", "equatorial", "icrs", "fk5", "j2000"),
}


@contextmanager
def opened(path: Path) -> Iterator[fits.HDUList]:
    """Open a FITS file, gzipped or not; astropy's warning of a truncated one is raised."""
    # Opened here, not by astropy, which leaves the file open when its own warning is raised.
    with warnings.catch_warnings(), path.open("rb") as stream:
        warnings.filterwarnings("error", message=".*truncated.*", category=AstropyUserWarning)
        try:
            hdus = fits.open(stream)
        except OSError as error:  # of any other format, with a remedy that is astropy's own
            raise OSError("it is no FITS file") if "No SIMPLE card" in str(error) else error from None
        with hdus:
            yield hdus


def first_table(hdus: fits.HDUList, columns: int = 1) -> fits.BinTableHDU | fits.TableHDU:
    """Return the first table of a FITS file; raise ValueError if there is none, or it has fewer ``columns``."""
    table = next((hdu for hdu in hdus if isinstance(hdu, fits.BinTableHDU | fits.TableHDU)), None)
    if table is None:
        raise ValueError("it has no table")
    if len(table.columns) < columns:
        raise ValueError(f"its table has {len(table.columns)} of {columns} columns")
    return table


def read_coefficients(path: Path, what: str) -> tuple[Alm, int, fits.Header]:
    """Return coefficients from a file of ``healpy.write_alm``, their mmax and header; InputError for any other file."""
    # A file with infinities is refused later, by name; joining real and imaginary parts would warn of them.
    with (
        unreadable(path, what, "give FITS with the columns index, real, imaginary, and a row for each l and m"),
        opened(path) as hdus,
        np.errstate(invalid="ignore"),
    ):
        table = first_table(hdus, 3)
        if str(table.header.get("PIXTYPE", "")).strip().upper() == "HEALPIX" or not len(table.data):
            raise ValueError("it is a map" if len(table.data) else "its table has no rows")
        index = np.ravel(table.data.field(0)).astype(np.int64)
        ell = np.floor(np.sqrt(np.maximum(index - 1, 0))).astype(np.int64)
        lmax, mmax = int(ell.max()), int((index - ell * (ell + 1) - 1).max())
        rows = healpy.Alm.getsize(lmax, mmax) if mmax >= 0 else 0
        if index.min() < 1:
            raise ValueError(f"its first column has {index.min()}, where the index l(l + 1) + m + 1 is 1 or more")
        if np.unique(index).size < index.size or index.size != rows:  # healpy would put them in other places
            raise ValueError(f"it has {index.size} rows, where every l up to {lmax} and m up to {mmax} make {rows}")
        packed, mmax = healpy.read_alm(table, return_mmax=True)
        table.header["COORDSYS"] = stated_frame(hdus, str(path)) or ""
        return packed, int(mmax), table.header


def frame_named(coordsys: object, where: str, key: str = "COORDSYS") -> str | None:
    """Return the frame that a keyword ``key`` of a file, ``where``, names; None if it is missing or empty.

    Raise InputError for a word that names none of the three frames.
    """
    word = str(coordsys or "").strip().lower()
    if word in SILENT:
        return None
    for frame, words in _FRAMES.items():
        if word in words:
            return frame
    raise InputError(f"{where} has {key} = {coordsys!r}, but it must be E, G or C (ecliptic, galactic, equatorial).")


def stated_frame(hdus: fits.HDUList, where: str) -> str | None:
    """Return the frame that COORDSYS of a file's first table names, or that of its primary header; None without.

    Raise InputError for a word that names none, and for two headers that contradict each other.
    """
    own, primary = (frame_named(one.header.get("COORDSYS"), where) for one in (first_table(hdus), hdus[0]))
    if own and primary and own != primary:
        raise InputError(
            f"{where} has a table in {own} coordinates, and {primary} ones in its primary header; mend one."
        )
    return own or primary


def radians(unit: str) -> float:
    """Return the factor from a unit of angle to radians; raise InputError for any other unit."""
    from astropy import units as u

    try:
        return float(u.Unit(re.sub("^(deg|rad|arc)(.*)s$", r"\1\2", unit.strip().lower())).to(u.rad))
    except (ValueError, TypeError):
        raise InputError(f"the unit {unit!r} is none of angle; give rad, deg, arcmin or arcsec.") from None


def to_uk(unit: str | None, path: Path, frequency_ghz: float | None = None) -> float:
    """Return the factor from a unit to uK of CMB (thermodynamic) temperature; 1 if the header gives none.

    ``unit`` is as in a header: uK, mK, K (CMB temperature unless they say antenna or RJ), or a brightness such as
    MJy/sr; ``path`` names the file in messages. Antenna temperature and brightness need the channel's frequency. Raise
    InputError for another unit, or if a needed frequency is missing.

    Notes
    -----
    The conversions are those of ``astropy.units`` at one frequency: d B_nu / d T at 2.7255 K for the CMB,
    2 nu^2 k / c^2 for antenna (Rayleigh-Jeans) temperature. A wide band needs its own factor.
    """
    text = (unit or "").strip().replace("µ", "u").replace("μ", "u")
    if text.lower() in SILENT:
        return 1.0
    kelvin = _KELVIN.fullmatch(text.lower())
    if kelvin and not kelvin[3]:
        return _PREFIXES[kelvin[1]]
    if kelvin:
        return _PREFIXES[kelvin[1]] * _brightness_to_k(unit, path, frequency_ghz, None)
    return 1e6 * _brightness_to_k(unit, path, frequency_ghz, text)


def refuse_temperature(unit: str | None, path: Path, wanted: str) -> None:
    """Raise InputError if a unit is one of temperature, or of its square, where ``wanted`` has neither."""
    text = (unit or "").strip().replace("µ", "u").replace("μ", "u").lower()
    squared = _SQUARE.fullmatch(text)
    if _KELVIN.fullmatch(text) or (squared and _KELVIN.fullmatch(squared[1])):
        raise InputError(f"{path} is in {unit!r}, but {wanted} has no such unit; give another file, or correct TUNIT.")


def to_uk2(unit: str | None, path: Path, frequency_ghz: float | None = None) -> float:
    """Return the factor from a unit of variance, such as K_CMB^2 or mK**2, to uK^2; 1 if the header gives none.

    Raise InputError for a unit that is no square of what :func:`to_uk` knows.
    """
    if (unit or "").strip().lower() in SILENT:
        return 1.0
    squared = _SQUARE.fullmatch(str(unit).strip())
    if squared is None:
        raise InputError(f"{path} is in {unit!r}, where a variance is in uK^2, mK^2 or K^2; give variances.")
    return to_uk(squared[1], path, frequency_ghz) ** 2


def _brightness_to_k(unit: str | None, path: Path, frequency_ghz: float | None, text: str | None) -> float:
    """Return K of CMB temperature per unit ``text`` of brightness, or per K of antenna temperature (None)."""
    from astropy import units as u

    sky = u.Jy / u.sr
    try:
        brightness = u.K if text is None else u.Unit(text.replace("Jysr", "Jy sr"))
    except (ValueError, TypeError):
        brightness = u.dimensionless_unscaled
    if text is not None and not brightness.is_equivalent(sky):
        raise InputError(f"{path} is in {unit!r}; give a map in uK, mK or K (CMB or antenna temperature), or MJy/sr.")
    if frequency_ghz is None:
        raise InputError(
            f"{path} is in {unit!r}, which is no CMB temperature; give the channel's frequency_ghz to convert it, or a "
            "map in uK (CMB)."
        )
    frequency = frequency_ghz * u.GHz
    value = (1.0 * brightness).to(sky, u.brightness_temperature(frequency))
    return float(value.to_value(u.K, u.thermodynamic_temperature(frequency, T_cmb=T_CMB_K * u.K)))
