"""Measured BipoSH spectra from a table: ECSV with columns L, M, d, ell_min, ell_max, value, error."""

import re
import warnings
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from astropy import units
from astropy.table import Table
from numpy.typing import NDArray

from mcsim.beamfit.data import EVERYTHING, SUMMARY, Measurement, Row, Scaling, Selection, is_of_one_map, refuse_filtered
from mcsim.bipolar import Mode
from mcsim.errors import InputError
from mcsim.support.folders import unreadable

SPARE = 3  #: realizations beyond the bins that a fit with their covariance needs
COLUMNS = ("L", "M", "d", "ell_min", "ell_max")  #: columns that identify the content of a row


def read_table(path: str | Path, frame: str, selection: Selection = EVERYTHING, errors: bool = True) -> Measurement:
    """Read binned spectra with independent errors from an ECSV table, which must have the frame of the model.

    Columns are L, M, d, ell_min, ell_max, value, error, and value_imag if parts are imaginary; ``value`` is the mean
    over ell_min <= l2 <= ell_max, d = l2 - l1, with its unit. ``error`` of a mode with M > 0 is that of the modulus;
    its parts may have errors of their own, error_real and error_imag. The header's ``meta`` holds ``normalisation``
    ("Bennett", "WMAP" or "Hajian-Souradeep"), ``scaling`` ("l(l+1)/2pi" or "none") and optionally ``frame`` and
    ``lmax``, the highest degree of the maps (default: of the configuration). ``mcsim info --export`` writes such
    tables, with a column ``pair`` and, for paired ensembles, ``value_difference`` and so on.
    ``errors`` False: those of the table do not count, and are one each.
    Raise InputError for a table that cannot be read, does not define its numbers, or has the errors of fewer
    ``realizations`` (in its meta) than a fit takes from a store.
    """
    table = read_ecsv(path)
    refuse_filtered(path, str(table.meta.get("filter", "none")))
    suffix, chosen = _kind(path, table, selection.kind)
    scaling = scaling_of(path, table.meta)
    check_frame(path, str(table.meta.get("frame", frame)).lower(), frame)
    label = selection.pair
    if "pair" in table.colnames:
        labels = [str(name) for name in table["pair"]]
        label = labels[0] if label is None else label
        if label not in labels:
            raise InputError(f"There is no pair {label} in {path}; choose among {'; '.join(dict.fromkeys(labels))}.")
        table = table[[name == label for name in labels]]
    L, M, d, low, high = identified(path, table)
    wrong = np.flatnonzero((low < 0) | (low > high))
    if len(wrong):
        a, b = low[wrong[0]], high[wrong[0]]
        raise InputError(f"{path}: ell_min = {a}, ell_max = {b} is no range; correct the row.")
    first, last = selection.ell_range or (0, int(high.max()))
    real, error = (in_uk2(path, table, f"{name}{suffix}") for name in ("value", "error"))
    of_parts = errors_of_parts(path, table, error, suffix)
    rows: list[Row] = []
    values: list[NDArray[np.float64]] = []
    sigmas: list[NDArray[np.float64]] = []
    for mode in selection.parsed:
        check_parity(path, mode, scaling)
        same = np.flatnonzero((L == mode.L) & (M == mode.M) & (d == mode.d) & (low >= first) & (high <= last))
        for imaginary in mode.parts:
            part = in_uk2(path, table, f"value_imag{suffix}") if imaginary else real
            rows += [Row(mode, int(low[i]), int(high[i]), imaginary) for i in same]
            values.append(part[same])
            sigmas.append((error if mode.M == 0 else of_parts[imaginary])[same])
    if not rows:
        raise InputError(
            f"{path} has no row of {', '.join(selection.modes)} within ell = {first} ... {min(last, high.max())}, and "
            f"ends at ell = {high.max()}; choose others."
        )
    if len(set(rows)) < len(rows):
        raise InputError(f"{path} gives a bin of one mode twice; keep one row of each.")
    _check_modes(path, selection, rows, label)
    count = count_of(path, table.meta)
    if errors:
        _warn_of_overlaps(path, rows)
        if "prediction" not in table.meta:  # whose errors are known
            _check_count(path, count, len(rows))
    value = np.concatenate(values)
    sigma = np.concatenate(sigmas) if errors else np.ones_like(value)
    bad = np.flatnonzero(~(np.isfinite(value) & np.isfinite(sigma) & (sigma > 0.0)))
    if len(bad):
        row, above = rows[bad[0]], max(rows[number].ell_min for number in bad) + 1
        remedy = "give finite values with errors above 0, or leave the row out"
        if suffix and not np.isfinite(sigma).any():
            remedy = "fit the plain spectra (--kind plain), or take errors from a store (--covariance)"
        elif any(one.ell_min >= above for one in rows):
            remedy += f" (--ell-min {above} leaves out all such rows)"
        raise InputError(
            f"{path}: {row.mode.name} at ell = {row.ell_min}-{row.ell_max} has value {value[bad[0]]:g}, error "
            f"{sigma[bad[0]]:g}; {remedy}."
        )
    covariance, highest = np.diag(sigma**2), highest_of(path, table.meta)
    return Measurement(
        str(path), label, chosen, tuple(rows), scaling, value, covariance, None, highest=highest, count=count
    )


def _check_modes(path: str | Path, selection: Selection, rows: list[Row], label: str | None) -> None:
    """Raise InputError for a mode that is asked for and not there, or that repeats another one of a single map."""
    found = {row.mode for row in rows}
    absent = [mode for mode in selection.parsed if mode not in found]
    if absent and selection.parsed != EVERYTHING.parsed:
        raise InputError(f"{path} has no {absent[0].name} at these ell; leave the mode out.")
    repeated = [mode for mode in selection.parsed if mode in found and not mode.in_auto]
    if repeated and is_of_one_map(label):
        raise InputError(
            f"{path}: {repeated[0].name} of one map is zero, or repeats the mode with d = {-repeated[0].d}; leave the "
            "mode out, or name the pair of different maps."
        )


def _warn_of_overlaps(path: str | Path, rows: Sequence[Row]) -> None:
    """Warn of bins of one mode that share degrees: errors of a table are taken for independent."""
    for one, other in pairwise(sorted(rows, key=lambda row: (row.mode, row.imaginary, row.ell_min))):
        if (one.mode, one.imaginary) == (other.mode, other.imaginary) and other.ell_min <= one.ell_max:
            warnings.warn(
                f"{path}: the bins of {one.mode.name} at ell = {one.ell_min}-{one.ell_max} and {other.ell_min}-"
                f"{other.ell_max} overlap, but errors of a table are taken for independent; give bins that share no "
                "ell, or the covariance of a store.",
                stacklevel=5,
            )
            return


def _check_count(path: str | Path, count: int, rows: int) -> None:
    """Refuse errors of a mean of few realizations; warn of what a table of one does not have."""
    instead = "fit the store, or take the covariance of one (--covariance)"
    if 1 < count < rows + SPARE:
        raise InputError(
            f"{path} has errors of {count} realizations, too few for {rows} bins without their correlations; {instead}."
        )
    if count > 1:
        warnings.warn(
            f"{path} has errors of {count} realizations without their correlations: bins are taken for independent, "
            f"with known errors; {instead}.",
            stacklevel=4,
        )


def count_of(path: str | Path, meta: Any) -> int:
    """Read from the header of a table of how many realizations it is the mean; InputError for no such number."""
    count = meta.get("realizations", 1)
    if isinstance(count, bool) or not isinstance(count, int) or count < 1:
        raise InputError(f"{path} is the mean of {count!r} realizations; give a whole number from 1 in its meta.")
    return count


def check_frame(path: str | Path, found: str, wanted: str) -> None:
    """Raise InputError if data are in another frame than the configuration."""
    if found != wanted:
        raise InputError(
            f"{path} is in the {found} frame, the configuration in the {wanted} one; rotate the data or set map.frame."
        )


def highest_of(path: str | Path, meta: Any) -> int | None:
    """Read the highest degree of the maps from the header of a table, None without one; InputError for no degree."""
    given = meta.get("lmax")
    if given is not None and (isinstance(given, bool) or not isinstance(given, int) or given < 0):
        raise InputError(f"{path}: lmax = {given!r} in its meta is no degree; write a whole number, or leave it out.")
    return given


def check_parity(path: str | Path, mode: Mode, scaling: Scaling) -> None:
    """Raise InputError for a mode that the normalisation does not have."""
    if mode.parity == "odd" and scaling.bennett and not scaling.summary:
        raise InputError(
            f"{path}: {mode.name} has odd parity, which the Bennett normalisation does not have; leave it out."
        )


def identified(path: str | Path, table: Table) -> NDArray[np.int64]:
    """Return :data:`COLUMNS`, shape (5, rows); raise InputError if one holds anything but integers."""
    found = []
    for name in COLUMNS:
        try:
            values: NDArray[np.float64] = np.ma.filled(np.ma.asarray(table[name], dtype=float), np.nan)
        except (ValueError, TypeError):
            values = np.array([np.nan])
        if not np.all(np.abs(values - np.round(values)) == 0.0):
            raise InputError(f"{path}: the column {name} holds values that are no integers; correct them.")
        found.append(values.astype(np.int64))
    return np.stack(found)


def read_ecsv(path: str | Path) -> Table:
    """Read an ECSV table with rows and :data:`COLUMNS`; raise InputError for anything else."""
    if not Path(path).is_file():
        raise InputError(f"{path} does not exist; give the folder of a store, or an ECSV table.")
    with unreadable(path, "an ECSV table", "give such a table, or a folder: a store to fit, or maps to diagnose"):
        table = Table.read(path, format="ascii.ecsv")
    if len(table) == 0:
        raise InputError(f"{path} has no rows; give the measured bins.")
    missing = [name for name in COLUMNS if name not in table.colnames]
    if missing:
        raise InputError(f"{path} has no column {missing[0]}; give {', '.join(COLUMNS)}, value and error.")
    return table


def errors_of_parts(
    path: str | Path, table: Table, error: NDArray[np.float64], suffix: str = ""
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the errors of real and imaginary parts of modes with M > 0, uK^2, shape (rows,) each.

    They are the table's own, or share the variance of ``error``, that of the modulus, equally.
    """
    real, imaginary = (
        in_uk2(path, table, name) if (name := f"error_{part}{suffix}") in table.colnames else error * np.sqrt(0.5)
        for part in ("real", "imag")
    )
    return real, imaginary


def _kind(path: str | Path, table: Table, kind: str | None) -> tuple[str, str]:
    """Return the suffix of the columns, and the kind of their spectra."""
    has_difference = "value_difference" in table.colnames
    chosen = ("difference" if has_difference else "plain") if kind is None else kind
    if chosen == "difference" and not has_difference:
        raise InputError(f"{path} has no column value_difference; fit its plain spectra.")
    return ("_difference" if chosen == "difference" else "", chosen)


def scaling_of(path: str | Path, meta: Any) -> Scaling:
    """Read the normalisation from the header of a table; raise InputError if it is unknown."""
    normalisation, scaling = (str(meta.get(name, "")).lower() for name in ("normalisation", "scaling"))
    if not normalisation:
        raise InputError(
            f'{path} does not say its normalisation; add normalisation: "Bennett" or "Hajian-Souradeep" to its meta.'
        )
    bennett = re.match(r"\W*(bennett|wmap)", normalisation) is not None
    if not bennett and re.match(r"\W*hajian", normalisation) is None:
        raise InputError(
            f"{path} has normalisation {normalisation!r}, which is not known; write Bennett or Hajian-Souradeep."
        )
    bare = re.sub(r"[\s()\\*_{}]", "", scaling.replace("ell", "l").replace("π", "pi"))
    spectrum = re.match(r"ll\+1/2pi($|,|a)", bare) is not None  # "A, mean over ..." may follow, but no other factor
    if not spectrum and bare not in ("none", "raw", "1"):
        raise InputError(f'{path} has scaling {scaling!r}, which is not known; write "l(l+1)/2pi" or "none".')
    # The header of an exported summary defines the scaling of odd parity.
    return SUMMARY if bennett and spectrum and "hajian" in normalisation else Scaling(bennett, spectrum, summary=False)


def in_uk2(path: str | Path, table: Table, name: str) -> NDArray[np.float64]:
    """Return a column in uK^2, NaN where masked; raise InputError if it is missing or has another unit."""
    if name not in table.colnames:
        raise InputError(f"{path} has no column {name}; add it.")
    column = table[name]
    if column.dtype.kind == "c":
        raise InputError(f"{path}: the column {name} is complex; give real parts, and imaginary ones as value_imag.")
    if column.unit is None:
        raise InputError(f"{path}: the column {name} has no unit; write uK2 (or mK2, K2) into its header.")
    try:
        factor = units.Unit(column.unit).to(units.uK**2)
    except (units.UnitConversionError, ValueError, TypeError):
        raise InputError(f"{path}: the column {name} has unit {column.unit}; convert it to uK2.") from None
    try:
        values: NDArray[np.float64] = np.ma.filled(np.ma.asarray(column, dtype=float), np.nan)
    except (ValueError, TypeError):
        wrong = next(row for row, text in enumerate(column) if not _is_number(text))
        raise InputError(
            f"{path}: the column {name} has {str(column[wrong])!r} in row {wrong + 1}, where a number in "
            f"{column.unit} is expected; correct the row or leave it out."
        ) from None
    return np.asarray(factor * values)


def _is_number(text: Any) -> bool:
    try:
        float(text)
    except (ValueError, TypeError):
        return False
    return True
