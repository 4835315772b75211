"""Measured BipoSH spectra from a table: ECSV with columns L, M, d, ell_min, ell_max, value, error."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from astropy import units
from astropy.table import Table
from numpy.typing import NDArray

from mcsim.beamfit.data import QUADRUPOLE, SUMMARY, Measurement, Row, Scaling, parse_mode, parts
from mcsim.errors import InputError

COLUMNS = ("L", "M", "d", "ell_min", "ell_max")
"""That say what is in a row."""


def read_table(
    path: str | Path,
    frame: str,
    modes: Sequence[str] = QUADRUPOLE,
    ell_range: tuple[int, int] | None = None,
    kind: str | None = None,
    pair: str | None = None,
) -> Measurement:
    """Read binned spectra with independent errors.

    Parameters
    ----------
    path
        ECSV table. Columns L, M, d, ell_min, ell_max, value, error, and value_imag where parts are imaginary;
        ``value`` is the mean over ell_min <= l2 <= ell_max, d = l2 - l1, with its unit. The header's ``meta`` holds
        ``normalisation`` ("Bennett", "WMAP" or "Hajian-Souradeep"), ``scaling`` ("l(l+1)/2pi" or "none") and
        optionally ``frame``. ``mcsim info --export`` writes such tables, with a column ``pair`` and, for paired
        ensembles, ``value_difference`` and so on.
    frame
        Frame of the model, which that of the table must equal.
    modes, ell_range, kind, pair
        As for :func:`mcsim.beamfit.data.from_store`.

    Raises
    ------
    InputError
        For a table that cannot be read, or leaves open what its numbers are.
    """
    table = read_ecsv(path)
    missing = [name for name in COLUMNS if name not in table.colnames]
    if missing:
        raise InputError(f"{path} has no column {missing[0]}; give {', '.join(COLUMNS)}, value and error.")
    suffix, chosen = _kind(path, table, kind)
    scaling = scaling_of(path, table.meta)
    found = str(table.meta.get("frame", frame)).lower()
    if found != frame:
        raise InputError(f"{path} is in the {found} frame, the configuration in the {frame} one; rotate one of them.")
    label = _pair(path, table, pair)
    if label is not None:
        table = table[[str(name) == label for name in table["pair"]]]
    wanted = [parse_mode(name) for name in modes]
    first, last = ell_range or (0, int(np.max(table["ell_max"])))
    real, error = (in_uk2(path, table, f"{name}{suffix}") for name in ("value", "error"))
    rows: list[Row] = []
    values: list[float] = []
    errors: list[float] = []
    for mode in wanted:
        for imaginary in parts(mode):
            part = in_uk2(path, table, f"value_imag{suffix}") if imaginary else real
            if mode.parity == "odd" and not scaling.summary and scaling.bennett:
                raise InputError(
                    f"{path}: {mode.name} has odd parity, which the Bennett normalisation does not have; leave it out."
                )
            for number, line in enumerate(table):
                low, high = int(line["ell_min"]), int(line["ell_max"])
                same = (int(line["L"]), int(line["M"]), int(line["d"])) == (mode.L, mode.M, mode.d)
                if not same or low < first or high > last:
                    continue
                if not 0 <= low <= high:
                    raise InputError(f"{path}: ell_min = {low}, ell_max = {high} is no range; correct the row.")
                rows.append(Row(mode, low, high, imaginary))
                values.append(float(part[number]))
                # The error of a mode with M > 0 is that of its modulus; its two parts share the variance.
                errors.append(float(error[number]) * (1.0 if mode.M == 0 else np.sqrt(0.5)))
    if not rows:
        raise InputError(f"{path} has no row of {', '.join(modes)} within ell = {first} ... {last}; choose others.")
    if len(set(rows)) < len(rows):
        raise InputError(f"{path} gives a bin of one mode twice; keep one row of each.")
    _check(path, rows, values, errors)
    value, variance = np.array(values), np.array(errors) ** 2
    return Measurement(str(path), label, chosen, tuple(rows), scaling, value, np.diag(variance), None)


def _check(path: str | Path, rows: Sequence[Row], values: Sequence[float], errors: Sequence[float]) -> None:
    for row, value, error in zip(rows, values, errors, strict=True):
        if not (np.isfinite(value) and np.isfinite(error) and error > 0.0):
            raise InputError(
                f"{path}: {row.mode.name} at ell = {row.ell_min}-{row.ell_max} has value {value:g}, error {error:g}; "
                "give finite values with errors above 0, or leave the row out."
            )


def read_ecsv(path: str | Path) -> Table:
    """An ECSV table that has rows; InputError where it is none."""
    try:
        table = Table.read(path, format="ascii.ecsv")
    except Exception as error:  # libraries raise whatever a broken file makes of them
        raise InputError(f"{path} cannot be read as an ECSV table ({error}); give a store or such a table.") from None
    if len(table) == 0:
        raise InputError(f"{path} has no rows; give the measured bins.")
    return table


def _kind(path: str | Path, table: Table, kind: str | None) -> tuple[str, str]:
    """Suffix of the columns, and what they are."""
    has_difference = "value_difference" in table.colnames
    chosen = ("difference" if has_difference else "plain") if kind is None else kind
    if chosen == "difference" and not has_difference:
        raise InputError(f"{path} has no column value_difference; fit its plain spectra.")
    return ("_difference" if chosen == "difference" else "", chosen)


def scaling_of(path: str | Path, meta: Any) -> Scaling:
    """What the header of a table says of its normalisation; InputError where it says nothing that is known."""
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
    spectrum = bare.startswith("ll+1/2pi")
    if not spectrum and bare not in ("none", "raw", "1"):
        raise InputError(f'{path} has scaling {scaling!r}, which is not known; write "l(l+1)/2pi" or "none".')
    # The header of an exported summary says by itself what its odd parity is.
    return SUMMARY if bennett and spectrum and "hajian" in normalisation else Scaling(bennett, spectrum, summary=False)


def _pair(path: str | Path, table: Table, pair: str | None) -> str | None:
    if "pair" not in table.colnames:
        return pair
    labels = list(dict.fromkeys(str(name) for name in table["pair"]))
    label = labels[0] if pair is None else pair
    if label not in labels:
        raise InputError(f"There is no pair {label} in {path}; choose among {'; '.join(labels)}.")
    return label


def in_uk2(path: str | Path, table: Table, name: str) -> NDArray[np.float64]:
    """A column in uK^2, NaN where it is masked; InputError where it is missing or has no such unit."""
    if name not in table.colnames:
        raise InputError(f"{path} has no column {name}; add it.")
    column = table[name]
    if column.unit is None:
        raise InputError(f"{path}: the column {name} has no unit; write uK2 (or mK2, K2) into its header.")
    try:
        factor = units.Unit(column.unit).to(units.uK**2)
        values: NDArray[np.float64] = np.ma.filled(np.ma.asarray(column, dtype=float), np.nan)
    except (units.UnitConversionError, ValueError, TypeError):
        raise InputError(f"{path}: the column {name} has unit {column.unit}; convert it to uK2.") from None
    return np.asarray(factor * values)
