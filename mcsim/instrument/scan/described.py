"""How a survey whose moments are given was pointed: a scan model, or the short description beside the moments."""

import math
import tomllib
from pathlib import Path

from mcsim.errors import InputError
from mcsim.instrument.scan.model import SECONDS_PER_DAY, ScanModel, model_from_table, number
from mcsim.sphere.checks import check_angle

_COPIED = ("spin_period_s", "precession_period_s", "precession_angle_deg", "orbit_period_s", "sample_period_s")


def read_described(path: str | Path) -> tuple[ScanModel, float | None]:
    """Return how a survey was pointed, and the amplitude of the dipole that it saw, uK; None if nothing is said of it.

    The file is a scan model (:meth:`mcsim.instrument.scan.ScanModel.load`), or a survey's short description: TOML with
    the periods and angles of a scan model, one ``boresight_angle_deg``, the number of ``samples``, the azimuth of every
    channel about the spin axis in a table ``spin_azimuth_rad``, and optionally ``dipole_uk``. Its lines of sight bear
    the names of the channels.

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
        return ScanModel.load(path), None
    azimuths = table["spin_azimuth_rad"]
    if not isinstance(azimuths, dict) or not azimuths:
        raise InputError(f"{path}: spin_azimuth_rad is {azimuths!r}; give a table, channel = radians.")
    where = str(path)
    boresight = number(table, "boresight_angle_deg", where)
    lines = []
    for name in azimuths:
        azimuth = number(azimuths, name, where)
        check_angle(azimuth, f"{where}: spin_azimuth_rad of {name}")
        lines.append({"name": name, "boresight_angle_deg": boresight, "azimuth_deg": math.degrees(azimuth)})
    copied = {key: number(table, key, where) for key in _COPIED}
    days = number(table, "samples", where) * copied["sample_period_s"] / SECONDS_PER_DAY
    model = {"schema": 1, "name": path.stem, **copied, "duration_days": days, "line_of_sight": lines}
    dipole = number(table, "dipole_uk", where) if "dipole_uk" in table else None
    return model_from_table(model, where), dipole
