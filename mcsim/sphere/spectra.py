"""Angular power spectra C_l in uK^2, from a packaged name, a text table or a FITS file."""

import gzip
import re
import warnings
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mcsim.errors import InputError
from mcsim.sphere.checks import check_whole
from mcsim.sphere.header import first_table, opened
from mcsim.support import resources
from mcsim.support.folders import unreadable
from mcsim.support.npy import read_npy

# Names of D_l = l(l+1) C_l / 2 pi in headers: D_l, Dl, D_ell, D_{\ell}, DlTT, l(l+1)Cl.
_NAMES_OF_D_L = re.compile(
    r"(?i)(?<![a-z])D_?\{?\\?(l|ell)(?=TT|[^a-z]|$)|(l|ell)\s*\*?\s*\((l|ell)\s*\+\s*1\)|dimensionless"
)
_NAMES_OF_C_L = re.compile(r"(?i)(?<![a-z])C_?[\{(]?\\?(l|ell)(?=TT|[^a-z]|$)")

_NAMES_OF_OTHERS = re.compile(r"(?i)(?<![a-z])(EE|BB|TE|ET|EB|TB|GRAD(IENT)?|CURL|[EGC]-[TEGC]|T-[EGC])(?![a-z])")
_NAMES_OF_TEMPERATURE = re.compile(
    r"(?i)(?<![a-z])(TT|T-T|temperature|C_?l(?![a-z_])(?![\W_]{0,3}(EE|BB|TE|ET|EB|TB)))(?![a-z])"
)

DEGREES = ("l", "ell", "multipole")  #: names of columns of ell in FITS tables

_TO_UK2 = {"uk2": 1.0, "muk2": 1.0, "microk2": 1.0, "mk2": 1e6, "k2": 1e12}
_UNIT = re.compile(
    r"(?i)(?<![a-z])(micro|mu|[muµμ])?\s*K([_\s{]*(CMB|thermo\w*|RJ|ant\w*)\}?)?(\s*(\^|\*\*)\s*\{?2\}?|2|²)(?![\w.])"
)

SMALLEST_D_UK2, LARGEST_D_UK2 = 1e-6, 1e9
"""Limits of the largest l(l+1) C_l / 2 pi (up to l = 100) of a sky: tables in K^2 lie below, in nK^2 above."""

SMALLEST_UNSTATED_UK2 = 0.03
"""The same for a table that does not state its unit: the CMB has 6000 uK^2, which is 0.006 mK^2."""

D_L_RANGE_UK2, D_L_SLOPE, D_L_ROWS = (50.0, 5e4), -0.8, 6
"""A table of D_l of the CMB, l <= 300: its median, least d ln / d ln l (C_l has -1.6) and least number of rows.

If it states no unit, the median may be in mK^2 as well.
"""


def load(spec: str | Path, lmax: int) -> NDArray[np.float64]:
    """Read a temperature power spectrum.

    Parameters
    ----------
    spec
        A packaged name (``"wmap7"``, ``"planck2018"``); or a text table of the two columns ell, C_ell [uK^2] (``#``
        starts a header line, which may state the unit; rows in any order, complete from ell = 2; ell = 0 and 1 may be
        absent and are zero then); or a FITS file as ``healpy.read_cl`` reads: a table in the first extension whose
        first column is TT from ell = 0, or ell and the second TT; or a .npy file of C_l in uK^2 from ell = 0.
    lmax
        Highest degree wanted, >= 0.

    Returns
    -------
    ndarray
        C_l in uK^2 for l = 0..lmax, shape (lmax + 1,).

    Raises
    ------
    InputError
        If the file is missing or unreadable, its header names D_l or an unknown unit, the table ends below lmax or has
        gaps, a value is negative or not finite, or the numbers can only be D_l or in another unit.

    Warns
    -----
    UserWarning
        If a white spectrum, or one whose header names C_l, has the size of D_l of the CMB.

    Notes
    -----
    The unit is that of a FITS column's TUNIT or a text table's header line: uK^2, mK^2 and K^2 are converted (a CMB
    marker such as uK_CMB^2 is understood). A table without unit is taken to be in uK^2 if its size allows it. C_l of
    the CMB falls as l^-2, D_l does not. The packaged tables reach l = 4096; ``workflows/spectra/make_spectra.py``
    states their parameters and accuracy.
    """
    check_whole(lmax, "lmax")
    cl, names, stated = _read(spec)
    if _NAMES_OF_OTHERS.search(names) and not _NAMES_OF_TEMPERATURE.search(names):
        raise InputError(
            f"power spectrum {str(spec)!r} says {names.strip()[:60]!r}, so it is not of the temperature; give TT."
        )
    if not len(cl):
        raise InputError(f"power spectrum {str(spec)!r} is empty; give C_l from l = 0 to {lmax}.")
    if len(cl) <= lmax:
        raise InputError(
            f"power spectrum {str(spec)!r} ends at l = {len(cl) - 1}, but lmax = {lmax} is wanted; "
            "lower lmax or give a longer table."
        )
    table = np.where(np.isfinite(cl), cl, 0.0)
    cl = cl[: lmax + 1].copy()
    for bad, what in ((~np.isfinite(cl), "not finite"), (cl < 0.0, "negative")):
        if bad.any():
            ell = int(np.argmax(bad))
            raise InputError(
                f"power spectrum {str(spec)!r} has C_l = {cl[ell]:g} at l = {ell}, which is {what}; correct the table."
            )
    where = f"power spectrum {str(spec)!r}"
    _check_size(where, table, stated)
    _check_shape(where, table, _NAMES_OF_C_L.search(names) is not None, stated)
    return cl


def last(spec: str | Path) -> int:
    """Return the last degree of a spectrum as :func:`load` reads it."""
    return len(_read(spec)[0]) - 1


def _read(spec: str | Path) -> tuple[NDArray[np.float64], str, bool]:
    """Return all C_l, the names in the header, and True if it states the unit."""
    if str(spec) in resources.names("data"):
        return _packaged(str(spec))
    path = resources.spectrum(spec)
    if path.suffix == ".npy":
        return read_npy(path, "iuf").astype(np.float64), "", False
    if path.name.lower().removesuffix(".gz").endswith((".fits", ".fit")):
        return _read_fits(path)
    return _read_text(path)


@lru_cache(maxsize=4)
def _packaged(name: str) -> tuple[NDArray[np.float64], str, bool]:
    """Read a packaged table, which does not change under a process as a user's file may."""
    cl, names, stated = _read_text(resources.spectrum(name))
    cl.setflags(write=False)
    return cl, names, stated


def _check_size(where: str, cl: NDArray[np.float64], stated: bool) -> None:
    """Raise InputError for numbers that are not a spectrum in uK^2."""
    ell = np.arange(2, min(len(cl), 101))
    largest = float(np.max(ell * (ell + 1) * cl[ell] / (2 * np.pi), initial=0.0))
    least = SMALLEST_D_UK2 if stated else SMALLEST_UNSTATED_UK2
    if largest > 0.0 and not least < largest < LARGEST_D_UK2:
        raise InputError(
            f"{where} has l(l+1) C_l / 2 pi of at most {largest:.3g} up to l = 100, where the CMB has 1000 to 6000 "
            "uK^2; convert it to uK^2, or say its unit (TUNIT1, or a line such as '# ell, C_ell [K^2]')."
        )


def _check_shape(where: str, cl: NDArray[np.float64], named: bool, stated: bool) -> None:
    """Raise InputError for a table of D_l, or of C_l that starts at ell = 2; warn if it may be right."""
    first = np.arange(min(len(cl), 8))
    if len(first) == 8 and cl[:8].min() > 0.0:
        shifted, own = (first + 2) * (first + 3) * cl[:8], (first * (first + 1) * cl[:8])[2:]
        if shifted.max() < 1.6 * shifted.min() and own.max() > 1.6 * own.min():
            raise InputError(f"{where} seems to start at ell = 2; put zeros for ell = 0 and 1 before it.")
    ell = np.arange(2, min(len(cl), 301))
    ell = ell[cl[ell] > 0.0]
    low, high = D_L_RANGE_UK2
    if len(ell) < D_L_ROWS:
        return
    median, white = float(np.median(cl[ell])), np.ptp(cl[ell]) < 1e-3 * cl[ell[0]]
    in_mk2 = not stated and not white and low < _TO_UK2["mk2"] * median < high
    if not (low < median < high or in_mk2):
        return
    slope = np.polyfit(np.log(ell), np.log(cl[ell]), 1)[0]
    if slope < D_L_SLOPE or (white and named):
        return
    message = (
        f"{where} has {median:.3g} as its median up to l = {ell[-1]} and does not fall as C_l of the CMB does, so it "
        f"seems to hold D_l = l(l+1) C_l / 2 pi in {'mK^2' if in_mk2 else 'uK^2'}; divide by l(l+1) / 2 pi, or name "
        "the column C_ell if it is C_l."
    )
    if not (white or named):
        raise InputError(message)
    warnings.warn(str(InputError(message)), stacklevel=3)  # which names what was given as an array


def _refuse_d_l(path: Path, header: str) -> None:
    if _NAMES_OF_D_L.search(header):
        raise InputError(
            f"power spectrum {str(path)!r} says {header.strip()[:60]!r}, so it seems to hold D_l = l(l+1) C_l / 2 pi "
            "or to be dimensionless, but C_l in uK^2 is wanted; divide by l(l+1) / 2 pi and name the columns "
            "'ell, C_ell [uK^2]'."
        )


def _read_text(path: Path) -> tuple[NDArray[np.float64], str, bool]:
    """Read C_l in uK^2, the header lines, and True if they state a unit."""
    with unreadable(f"power spectrum {str(path)!r}", "text", "give a text table or a FITS file"):
        contents = path.read_bytes()
        lines = (gzip.decompress(contents) if path.suffix == ".gz" else contents).decode("utf-8-sig").splitlines()
    found: dict[int, float] = {}
    header = ""
    for number, line in enumerate(lines, start=1):
        row = line.strip()
        if row.startswith("#"):
            _refuse_d_l(path, row)
            header += f"{row}\n"
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
    factors = {_factor(path, match[0]) for match in _UNIT.finditer(header)}
    if len(factors) > 1:
        raise InputError(f"power spectrum {str(path)!r} names several units in its header lines; leave one of them.")
    return cl * max(factors, default=1.0), header, bool(factors)


def _read_fits(path: Path) -> tuple[NDArray[np.float64], str, bool]:
    """Read C_l in uK^2, the column's name, and True if it states a unit."""
    remedy = "give a file as healpy.write_cl writes it"
    with unreadable(f"power spectrum {str(path)!r}", "a FITS table", remedy), opened(path) as hdus:
        table = first_table(hdus)
        header = table.header
        columns = [
            np.ravel(np.ma.filled(table.data.field(i), np.nan)).astype(np.float64)
            for i in range(min(2, len(table.columns)))
        ]
    # If the first column counts up, it is ell and the second is C_l.
    ell, called = columns[0], str(table.columns.names[0])
    named = called.strip().lower() in DEGREES
    few = 0 if named else 3
    counts = len(columns) == 2 and len(ell) > few and np.array_equal(ell, ell[0] + np.arange(len(ell))) and ell[0] >= 0
    if named and not counts:
        raise InputError(
            f"power spectrum {str(path)!r} has no C_l for every ell one by one beside its column {called}; give every "
            "ell from 2 to its last one."
        )
    column = 2 if counts else 1
    cl = columns[1] if counts else columns[0]
    if counts:
        cl = np.concatenate([np.zeros(int(ell[0])), cl])
        if ell[0] > 2 or ell[0] % 1:
            raise InputError(f"power spectrum {str(path)!r} starts at ell = {ell[0]:g}; give every ell from 2 on.")
    name = str(header.get(f"TTYPE{column}", ""))
    _refuse_d_l(path, name)
    unit = str(header.get(f"TUNIT{column}", "")).strip()
    if unit.lower() in ("", "unknown"):
        return cl, name, False
    return cl * _factor(path, unit), name, True


def _factor(path: Path, unit: str) -> float:
    """Return the factor from the square of a temperature unit to uK^2."""
    key = re.sub(
        r"[\s^_*(){}]|cmb|thermo(dynamic)?", "", unit.lower().replace("µ", "u").replace("μ", "u").replace("²", "2")
    )
    if key not in _TO_UK2:
        raise InputError(
            f"power spectrum {str(path)!r} has the unit {unit!r}; convert it to uK^2 (mK^2 and K^2 are read too)."
        )
    return _TO_UK2[key]
