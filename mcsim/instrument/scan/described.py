"""How a survey whose moments are given was pointed: a scan model, or the short description beside the moments."""

import math
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mcsim.errors import InputError
from mcsim.instrument.scan.model import SECONDS_PER_DAY, ScanModel, model_from_table
from mcsim.sphere.checks import check_angle

_COPIED = (
    "spin_period_s",
    "precession_period_s",
    "precession_angle_deg",
    "orbit_period_s",
    "sample_period_s",
)


@dataclass(frozen=True)
class Described:
    """A survey's pointing and the amplitude of the dipole that it saw, in uK; None where nothing is said of it."""

    model: ScanModel
    dipole_uk: float | None = None


def read_described(path: str | Path) -> Described:
    """Read how a survey was pointed.

    Parameters
    ----------
    path
        A scan model (:meth:`mcsim.instrument.scan.ScanModel.load`), or a survey's short description: a TOML file with
        the periods and angles of a scan model, one ``boresight_angle_deg``, the number of ``samples``, the azimuth of
        every channel about the spin axis in a table ``spin_azimuth_rad``, and optionally ``dipole_uk``. Its lines of
        sight bear the names of the channels.

    Raises
    ------
    InputError
        If the file cannot be read, lacks a number, or is of neither kind.
    """
    path = Path(path)
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError, RecursionError) as error:
        raise InputError(f"{path} is not a readable TOML file ({error}); give a scan model.") from None
    if "spin_azimuth_rad" not in table:
        return Described(ScanModel.load(path))
    azimuths = table["spin_azimuth_rad"]
    wanted = {key: _number(table, key, path) for key in (*_COPIED, "boresight_angle_deg", "samples")}
    if not isinstance(azimuths, dict) or not azimuths:
        raise InputError(f"{path}: spin_azimuth_rad is {azimuths!r}; give a table, channel = radians.")
    lines = [
        {
            "name": name,
            "boresight_angle_deg": wanted["boresight_angle_deg"],
            "azimuth_deg": math.degrees(_azimuth(azimuths, name, path)),
        }
        for name in azimuths
    ]
    model = model_from_table(
        {
            "schema": 1,
            "name": path.stem,
            **{key: wanted[key] for key in _COPIED},
            "duration_days": wanted["samples"] * wanted["sample_period_s"] / SECONDS_PER_DAY,
            "line_of_sight": lines,
        },
        str(path),
    )
    dipole = _number(table, "dipole_uk", path) if "dipole_uk" in table else None
    return Described(model, dipole)


def _azimuth(table: dict[str, Any], name: str, path: Path) -> float:
    azimuth = _number(table, name, path)
    check_angle(azimuth, f"{path}: spin_azimuth_rad of {name}")
    return azimuth


def _number(table: dict[str, Any], key: str, path: Path) -> float:
    value = table.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise InputError(f"{path}: {key} is {value!r}, but it must be a finite number.")
    return float(value)
